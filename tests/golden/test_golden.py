import pytest

from tests.golden.__main__ import main
from tests.golden.adapters import ADAPTERS
from tests.golden.runner import checks_of


@pytest.mark.parametrize("case", sorted(ADAPTERS))
def test_case_is_within_tolerance(case, shared_data):
    (file,) = (shared_data / "golden").glob(f"*/{case}.*")
    missed = [check for check in checks_of(file) if not check.passed]
    assert missed == []


def test_a_folder_without_golden_values_is_an_error(tmp_path, capsys):
    assert main(tmp_path) == 2
    assert "no golden values" in capsys.readouterr().err


def test_a_missed_tolerance_is_an_error(shared_data, monkeypatch, capsys):
    from presight_core.field import losses

    monkeypatch.setattr(losses, "sky_loss", lambda accumulation, is_sky: accumulation.sum())
    assert main(shared_data / "golden") == 1
    assert "MISS  nerf/losses  sky" in capsys.readouterr().out
