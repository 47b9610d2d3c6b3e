"""The `presight` command."""


def main() -> None:
    """Run the command line."""
