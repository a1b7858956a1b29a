"""Help while a file's text is edited: mistakes by line, keys that fit, explanations, tables to insert."""

import pytest

from wavefocus.config.editing import MODELS, commented_table, completions, help_at, mistakes_in
from wavefocus.config.fields import tables_of
from wavefocus.config.loading import parse_toml
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.config.scene import SceneConfig

SCENE = """[scene]
name = "two"
[[source]]
path = { kind = "point", at_mm = [0, 0] }
signal = { kind = "impulse" }
[[source]]
step_mm = 4.0
path = { kind = "line", start_mm = [0, 0], end_mm = [0, "x"] }  # its own
signal = { kind = "sine", frequency = 200, duration_s = 0.1 }
"""


def test_given_mistakes_then_each_is_at_its_line_in_the_words_of_the_command_line():
    found = [(one.line, one.sentence) for one in mistakes_in(SCENE, SceneConfig)]
    assert [line for line, _ in found] == [7, 8, 8]
    assert "source[1].path.end_mm[1]" in found[0][1]
    assert any("did you mean frequency_hz?" in sentence for _, sentence in found)
    (wrong,) = mistakes_in("[scene]\nname = \n", SceneConfig)
    assert wrong.line == 1
    assert wrong.sentence.startswith("not TOML")
    assert "this is a rig file" in mistakes_in("[mirror]\n", SceneConfig)[0].sentence
    (low,) = mistakes_in("[capture]\n[sweep]\nstop_hz = 6000.0\n", RunConfig)
    assert (low.line, "must be below 5000" in low.sentence) == (2, True)


@pytest.mark.parametrize(
    ("text", "kind", "word", "others"),
    [
        ("[[source]]\nam", "scene", "amplitude = ", ["start_s = "]),
        ("[[source]]\npath = { kind = ", "scene", '"circle"', ["kind = "]),
        ('[[source]]\npath = { kind = "circle", ', "scene", "radius_mm = ", ["end_mm = "]),
        ('[[source]]\n[source.path]\nkind = "line"\ne', "scene", "end_mm = ", ["radius_mm = "]),
        ("[[so", "scene", "[[source]]", ["[scene]"]),
        ("[mirror]\ndriver = ", "rig", '"virtual"', []),
        ("[capture]\nkeep_raw = ", "run", "true", []),
        ("[scene]\nname = 3  # ki", "scene", None, []),
        ("[nonsense]\na", "scene", None, []),
    ],
)
def test_given_a_place_then_the_keys_and_values_that_fit_are_listed(text, kind, word, others):
    found = completions(text, len(text), MODELS[kind])[1]
    assert word in found if word else found == []
    assert not set(others) & set(found)


def test_given_a_key_or_a_heading_then_its_explanation_has_unit_and_bounds():
    assert "(mm/s, 0 or more)" in help_at("[[source]]\nspeed_mm_s = 3", 14, SceneConfig)
    assert help_at('[[source]]\npath = { kind = "line", start_mm = [0, 0] }', 37, SceneConfig).startswith("start_mm: ")
    assert "what it emits" in help_at("[[source]]\n", 4, SceneConfig)
    assert help_at("# words", 3, SceneConfig) == ""
    assert mistakes_in("", RigConfig) == []


@pytest.mark.parametrize(
    ("kind", "heading"),
    [(kind, key) for kind, model in MODELS.items() for key in model.model_fields if tables_of(model, key)],
)
def test_given_any_table_to_insert_then_it_is_toml_and_each_of_its_keys_is_known(kind, heading):
    text = commented_table(kind, heading)
    assert heading in parse_toml(text, "")
    assert not [one for one in mistakes_in(text, MODELS[kind]) if "unknown key" in one.sentence]
    assert text.count("#") >= len(tables_of(MODELS[kind], heading)[0].model_fields) // 2
    if heading in ("grid", "sweep", "capture", "drift", "mirror", "watch", "recovery"):
        assert mistakes_in(text, MODELS[kind]) == []
