"""Compare this project with golden values: `python -m tests.golden DIR`, DIR holding them at any depth.

Prints the error and tolerance of each case, and ends with 1 if one is missed, 2 if there is nothing to compare. A
file that no adapter can read is missed too.
"""

import sys
from pathlib import Path

from tests.golden.runner import checks_of, golden_files


def main(folder: Path) -> int:
    """Print a line for each quantity of each case; the exit code."""
    files = golden_files(folder)
    if not files:
        print(f"{folder}: no golden values; name the folder that holds nerf/ and perception/", file=sys.stderr)
        return 2
    missed = sum(_missed(f"{file.parent.name}/{file.stem}", file) for file in files)
    print(f"{missed} missed" if missed else "all within tolerance")
    return 1 if missed else 0


def _missed(name: str, file: Path) -> int:
    """Print the comparisons of one file; how many are missed."""
    try:
        checks = checks_of(file)
    except (LookupError, ValueError, AssertionError) as error:  # an unknown case, or arrays that do not fit
        print(f"MISS  {name}: {type(error).__name__}: {error}")
        return 1
    for check in checks:
        verdict = "ok  " if check.passed else "MISS"
        print(f"{verdict}  {name}  {check.quantity}: error {check.error:.2g}, tolerance {check.tolerance:.2g}")
    return sum(not check.passed for check in checks)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tests.golden DIR")
    sys.exit(main(Path(sys.argv[1])))
