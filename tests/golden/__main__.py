"""Compare this project with golden values: `python -m tests.golden DIR`, DIR being the folder that holds nerf/.

Prints the error and tolerance of each case, and ends with 1 if one is missed, 2 if there is nothing to compare.
"""

import sys
from pathlib import Path

from tests.golden.adapters import ADAPTERS
from tests.golden.runner import checks_of


def main(folder: Path) -> int:
    """Print a line for each quantity of each case; the exit code."""
    files = [file for file in sorted(folder.glob("*/*")) if file.suffix in (".npz", ".json")]
    if not files:
        print(f"{folder}: no golden values; name the folder that holds nerf/ and perception/", file=sys.stderr)
        return 2
    missed = 0
    for file in files:
        name = f"{file.parent.name}/{file.stem}"
        if file.stem not in ADAPTERS:
            print(f"skip  {name}: no adapter")
            continue
        for check in checks_of(file):
            missed += not check.passed
            verdict = "ok  " if check.passed else "MISS"
            print(f"{verdict}  {name}  {check.quantity}: error {check.error:.2g}, tolerance {check.tolerance:.2g}")
    print(f"{missed} missed" if missed else "all within tolerance")
    return 1 if missed else 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tests.golden DIR")
    sys.exit(main(Path(sys.argv[1])))
