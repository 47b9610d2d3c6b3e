"""Print what PreSight needs, of pyproject.toml with the extras that are named: so that an image has them in a layer
that stays while only the code changes.

python requirements.py EXTRA...
"""

import sys
import tomllib
from pathlib import Path


def requirements(project_file: Path, extras: list[str]) -> list[str]:
    """Requirements of the project and its extras. Raises KeyError for an extra that it does not have."""
    project = tomllib.loads(project_file.read_text(encoding="utf-8"))["project"]
    optional = [line for extra in extras for line in project["optional-dependencies"][extra]]
    return [*project["dependencies"], *optional]


if __name__ == "__main__":
    print("\n".join(requirements(Path("pyproject.toml"), sys.argv[1:])))
