import pytest

from presight_core.config import PRESETS, load_city_settings, load_workspace_settings
from presight_core.errors import SettingsError


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_valid(preset):
    assert load_city_settings(None, [f"preset={preset}"]).preset == preset


def test_the_paper_preset_has_the_papers_sizes():
    settings = load_city_settings(None, ["preset=paper"])
    assert (settings.training.steps, settings.training.batch_rays) == (100_000, 65_536)
    assert settings.sampling.proposal_samples == (128, 64)
    assert (settings.field.grid.levels, settings.field.grid.features_per_level, settings.field.grid.log2_rows) == (
        10,
        4,
        20,
    )


def test_the_file_wins_over_the_preset_and_the_command_line_over_both(tmp_path):
    file = tmp_path / "city.toml"
    file.write_text('preset = "demo"\n[training]\nsteps = 7\nbatch_rays = 9\n')
    settings = load_city_settings(file, ["training.steps=8"])
    assert (settings.training.steps, settings.training.batch_rays) == (8, 9)
    assert settings.sampling == load_city_settings(None, ["preset=demo"]).sampling


def test_a_typo_names_the_file_the_field_and_the_nearest_name(tmp_path):
    file = tmp_path / "city.toml"
    file.write_text("[training]\nstepz = 7\n")
    with pytest.raises(SettingsError, match=r"city\.toml: training\.stepz: unknown setting; did you mean steps\?"):
        load_city_settings(file)


def test_a_value_out_of_range_names_the_field_and_the_value():
    with pytest.raises(SettingsError, match=r"--set: training\.steps: .* \(got -3\)"):
        load_city_settings(None, ["training.steps=-3"])


@pytest.mark.parametrize("override", ["training", "training.steps.more=1", "preset=quick"])
def test_a_bad_override_is_refused(override):
    with pytest.raises(SettingsError):
        load_city_settings(
            None, [override, "training.steps=1"] if "more" not in override else ["training.steps=1", override]
        )


def test_broken_toml_names_the_file(tmp_path):
    file = tmp_path / "presight.toml"
    file.write_text("store = \n")
    with pytest.raises(SettingsError, match=r"presight\.toml"):
        load_workspace_settings(file)


def test_settings_cannot_be_changed():
    settings = load_city_settings(None)
    with pytest.raises(ValueError, match="frozen"):
        settings.preset = "paper"  # type: ignore[misc]
