import pytest

from presight_core.recipes import Recipe, canonical_json, differences


def recipe(**inputs: object) -> Recipe:
    return Recipe("tile", 1, {"steps": 10}, inputs)


def test_equal_recipes_have_equal_digests_whatever_the_order_of_keys():
    assert recipe(a=1, b=2).digest == recipe(b=2, a=1).digest


def test_any_change_changes_the_digest():
    assert (
        len({recipe().digest, recipe(a=1).digest, recipe(a=2).digest, Recipe("tile", 2, {"steps": 10}, {}).digest}) == 4
    )


def test_a_number_that_json_cannot_hold_is_refused():
    with pytest.raises(ValueError, match="JSON compliant"):
        canonical_json({"loss": float("nan")})


def test_differences_name_the_setting_and_both_values():
    assert differences({"training": {"steps": 10}}, {"training": {"steps": 20}}) == ["training.steps: 10 -> 20"]


def test_differences_name_what_was_added_and_removed():
    assert differences({"drives": ["a", "b"]}, {"drives": ["b", "c"]}) == ["drives: c added", "drives: a removed"]


def test_equal_recipes_differ_in_nothing():
    assert differences(recipe(a=[1, {"b": 2}]).to_json(), recipe(a=[1, {"b": 2}]).to_json()) == []
