"""Tables that cannot be used as a whole: one line that names file and cure, and not a single drive."""

import json
import random

import pytest

from presight_core.errors import InputError
from stages.ingest import ingest_nuscenes

VERSION = "v1.0-mini"


def spoil(tables, table: str, row: int = 0, **values):
    tables[table][row].update(values)


TABLE_FAULTS = {
    # fault: (spoiler of the tables, the file at fault, what the message must say)
    "dangling log": (lambda t: spoil(t, "scene", log_token="no"), "scene", "log_token 'no' is not in log.json"),
    "dangling scene": (lambda t: spoil(t, "sample", scene_token="no"), "sample", "'no' is not in scene.json"),
    "dangling first sample": (lambda t: spoil(t, "scene", first_sample_token="no"), "scene", "not in sample.json"),
    "dangling next": (lambda t: spoil(t, "sample", next="no"), "sample", "next 'no' is not in sample.json"),
    "circle of keyframes": (lambda t: spoil(t, "sample", 1, next="sample-0-0"), "sample", "already seen"),
    "keyframe of two scenes": (lambda t: spoil(t, "scene", 1, first_sample_token="sample-0-1"), "scene", "seen"),
    "dangling sample": (lambda t: spoil(t, "sample_data", sample_token="no"), "sample_data", "not in sample.json"),
    "dangling pose": (lambda t: spoil(t, "sample_data", ego_pose_token="no"), "sample_data", "not in ego_pose.json"),
    "dangling calibration": (
        lambda t: spoil(t, "sample_data", 2, calibrated_sensor_token="no"),
        "sample_data",
        "'no' is not in calibrated_sensor.json",
    ),
    "dangling sensor": (lambda t: spoil(t, "calibrated_sensor", sensor_token="no"), "calibrated_sensor", "sensor.json"),
    "pose twice": (lambda t: t["ego_pose"].append(t["ego_pose"][0]), "ego_pose", "appears twice"),
    "image twice": (lambda t: t["sample_data"].append(t["sample_data"][0]), "sample_data", "appears twice"),
    "log twice": (lambda t: t["log"].append(t["log"][0]), "log", "appears twice"),
    "sample twice": (lambda t: t["sample"].append(t["sample"][0]), "sample", "appears twice"),
    "scene name twice": (lambda t: spoil(t, "scene", 1, name="scene-0000"), "scene", "rename one"),
    "empty token": (lambda t: spoil(t, "log", token=""), "log", "token"),
    "no images": (lambda t: t.update(sample_data=[]), "sample_data", "no camera image"),
    "no scenes": (lambda t: t.update(scene=[]), "scene", "no rows"),
    "text for a number": (lambda t: spoil(t, "ego_pose", timestamp="noon"), "ego_pose", "row 0, timestamp"),
    "null for a pose": (lambda t: spoil(t, "ego_pose", 3, rotation=None), "ego_pose", "row 3, rotation"),
    "three quaternion parts": (lambda t: spoil(t, "ego_pose", rotation=[1, 0, 0]), "ego_pose", "length"),
    "negative width": (lambda t: spoil(t, "sample_data", width=-1), "sample_data", "width"),
    "number beyond 64 bits": (lambda t: spoil(t, "sample_data", timestamp=10**30), "sample_data", "timestamp"),
    "missing field": (lambda t: t["sample_data"][0].pop("width"), "sample_data", "row 0: Object missing"),
    "city that climbs": (lambda t: spoil(t, "log", location="../../etc"), "log", "cannot be a name"),
    "scene with a line break": (lambda t: spoil(t, "scene", name="a\nb"), "scene", "cannot be a name"),
    "camera with a slash": (lambda t: spoil(t, "sensor", channel="CAM/../.."), "sensor", "cannot be a name"),
}


def refusal(root, version: str = VERSION) -> str:
    """The message of the error that ingest raises before it gives out anything."""
    with pytest.raises(InputError) as caught:
        ingest_nuscenes(root, version)
    message = str(caught.value)
    assert "\n" not in message
    assert "; " in message  # the cure comes after the fact
    return message


@pytest.mark.parametrize("fault", TABLE_FAULTS)
def test_unusable_tables_are_refused_naming_file_and_fact(tiny, fault):
    spoiler, table, fact = TABLE_FAULTS[fault]
    spoiler(tiny.tables)
    message = refusal(tiny.write())
    assert message.startswith(str(tiny.folder / f"{table}.json"))
    assert fact in message


@pytest.mark.parametrize("table", ["log", "scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor"])
def test_a_missing_table_is_named(tiny, table):
    root = tiny.write()
    (tiny.folder / f"{table}.json").unlink()
    assert refusal(root).startswith(f"{tiny.folder / table}.json: missing; copy the table again")


@pytest.mark.parametrize("table", ["log", "sample_data", "ego_pose"])
def test_a_table_cut_short_is_named(tiny, table):
    root = tiny.write()
    file = tiny.folder / f"{table}.json"
    file.write_bytes(file.read_bytes()[:-40])
    assert refusal(root).startswith(f"{file}: the file ends in the middle; copy the table again")


def test_a_missing_root_is_named(tmp_path):
    assert refusal(tmp_path / "no").startswith(f"{tmp_path / 'no'}: no such folder; give the folder that holds samples")


def test_a_wrong_version_is_answered_with_those_present(tiny):
    assert refusal(tiny.write(), "v1.0-trainval").endswith("choose one of: v1.0-mini")


@pytest.mark.parametrize("version", ["", ".", "..", "../data/v1.0-mini", "/"])
def test_a_version_cannot_lead_out_of_the_root(tiny, version):
    assert "no tables of version" in refusal(tiny.write(), version)


def test_a_root_without_tables_is_told_to_get_them(tmp_path):
    assert "extract the data set's metadata archive" in refusal(tmp_path)


def test_random_damage_to_tables_is_survived_or_refused_in_one_line(tiny):
    """Bytes are overwritten, cut out or doubled: either the drives come out or an InputError does."""
    root = tiny.write()
    randomness = random.Random(0)
    outcomes = set()
    for _ in range(300):
        file = tiny.folder / f"{randomness.choice(list(tiny.tables))}.json"
        sound = file.read_bytes()
        file.write_bytes(damaged(sound, randomness))
        try:
            outcomes.add(len(list(ingest_nuscenes(root, VERSION))))
        except InputError as error:
            assert "\n" not in str(error)
            assert str(root) in str(error)
            outcomes.add("refused")
        file.write_bytes(sound)
    assert {"refused", 2} <= outcomes


def damaged(text: bytes, randomness: random.Random) -> bytes:
    start = randomness.randrange(len(text))
    end = min(len(text), start + randomness.choice([1, 1, 1, 5, 200]))
    kind = randomness.choice(["overwrite", "cut", "double", "number"])
    if kind == "number":
        return text.replace(b"0.0", randomness.choice([b"NaN", b"1e999", b"-1", b"null", b'"x"', b"[]"]), 1)
    between = {"overwrite": randomness.randbytes(end - start), "cut": b"", "double": text[start:end] * 2}[kind]
    return text[:start] + between + text[end:]


def test_a_table_of_another_shape_is_refused(tiny):
    root = tiny.write()
    (tiny.folder / "log.json").write_text(json.dumps({"log": tiny.tables["log"]}))
    assert "not a JSON list" in refusal(root)
