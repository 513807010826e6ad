"""A configuration is built from layers, and whatever is wrong with one is said in a sentence."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from pydantic import ValidationError

from tracking3d.config.loading import config_schema, list_presets, load_config, parse_yaml, ready_files
from tracking3d.config.models import OnlineConfig, PaperConfig, PipelineConfig
from tracking3d.errors import InputError


@pytest.fixture
def yaml_file(tmp_path: Path):
    def write(text: str | bytes, name: str = "mine.yaml") -> Path:
        file = tmp_path / name
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return file

    return write


def test_there_is_one_default():
    assert PipelineConfig() == load_config() == load_config(preset="default")
    assert PipelineConfig().solver.name == "online"


def test_presets_are_listed_and_each_is_valid():
    assert {"default", "paper", "rerendering"} <= set(list_presets())
    for name in list_presets():
        load_config(preset=name)


def test_presets_choose_the_solver_and_only_the_default_one_looks_twice_and_corrects_the_tracker():
    solvers = {name: load_config(preset=name).solver for name in ("default", "rerendering", "paper")}
    assert {name: one.name for name, one in solvers.items()} == {
        "default": "online",
        "rerendering": "paper",
        "paper": "paper",
    }
    assert [name for name, one in solvers.items() if one.final_refine] == ["default"]
    assert [name for name, one in solvers.items() if one.tracker_feedback] == ["default"]


def test_later_layers_win_key_by_key(yaml_file):
    file = yaml_file("preset: paper\nsolver: {iterations: 7, sigma: 10, knum: 5}\ncrop: {size: 64}")
    config = load_config(
        file,
        overrides=["solver.sigma=20", "solver.weights.motion=2"],
        solver={"knum": 9},
        tracker="precomputed",
    )
    assert (config.solver.iterations, config.solver.sigma, config.solver.knum) == (7, 20, 9)
    assert config.solver.weights.motion == 2
    assert config.solver.weights.laplacian == 1000
    assert config.crop.size == 64
    assert config.tracker.name == "precomputed"


def test_named_preset_wins_over_the_files(yaml_file):
    file = yaml_file("preset: does_not_exist\ncrop: {size: 64}")
    assert load_config(file, preset="paper").crop.size == 64
    with pytest.raises(InputError, match="no preset 'does_not_exist'"):
        load_config(file)


def test_plugin_may_be_a_string_in_yaml_and_on_the_command_line(yaml_file):
    file = yaml_file("tracker: csrt\nfeatures: {name: rgb, x: 1}")
    config = load_config(file, overrides=["features=rgb"])
    assert config.tracker.name == "csrt"
    assert config.features.options == {"x": 1}


SHORT_FORMS = ["solver: paper", "solver: {name: paper}", "solver:\n  name: paper\n  iterations: 500"]


@pytest.mark.parametrize("text", SHORT_FORMS)
def test_a_solver_is_chosen_by_its_name_and_has_its_own_defaults(yaml_file, text):
    config = load_config(yaml_file(text))
    assert config.solver == PaperConfig()
    assert config.object == PipelineConfig().object
    assert PipelineConfig(solver="paper") == config


@pytest.mark.parametrize("section", [{"local_window": 8}, OnlineConfig(local_window=8)])
def test_settings_without_a_name_are_those_of_the_default_solver(section):
    assert PipelineConfig(solver=section) == load_config(overrides=["solver.local_window=8"])


def test_a_configuration_holds_only_what_its_solver_reads():
    online, paper = (load_config(preset=name).model_dump()["solver"] for name in ("default", "paper"))
    assert online.keys() & paper.keys() == {"name", "final_refine", "tracker_feedback", "weights"}
    assert "local_window" in online and "iterations" in paper
    assert not online["weights"].keys() & paper["weights"].keys()


def test_another_solver_drops_the_settings_of_the_one_below(yaml_file):
    file = yaml_file("preset: rerendering\nsolver: {iterations: 7}")
    assert load_config(file, overrides=["solver.name=online"]).solver == OnlineConfig()
    assert load_config(file, overrides=["solver=paper"]).solver.iterations == 7
    again = ["solver.name=paper", "solver.iterations=3", "solver.weights.motion=2"]
    for items in (again, again[::-1]):
        config = load_config(overrides=items)
        assert (config.solver.iterations, config.solver.weights.motion) == (3, 2)
        assert config.solver.weights.laplacian == 1000


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "solver: {iterations: 40}",
            r"'solver.iterations' is a setting of the solver 'paper', and the solver is 'online'; leave it out, or "
            r"choose 'paper' by 'solver.name'\.$",
        ),
        (
            "preset: paper\nsolver: {local_window: 4}",
            "'solver.local_window' is a setting of the solver 'online', and the solver is",
        ),
        ("solver: {weights: {motion: 1}}", "there is no setting 'solver.weights.motion'"),
        (
            "solver: {sigma: 1, tau: 1, knum: 1, silhouette_bias: none, stop: plateau}",
            "'solver.sigma', 'solver.tau', 'solver.knum' and 2 more are settings of the solver 'paper'.*leave them out",
        ),
        (
            "solver: {online: {points: 1}}",
            "'solver.online' is not a section; write the settings of the solver 'online' directly under 'solver'",
        ),
        ("preset: paper\nsolver: {online: {points: 1}}", "next to 'name: online'"),
        ("iterations: 3", "did you mean 'solver.iterations'?"),
    ],
)
def test_a_setting_of_the_other_solver_is_told_where_it_belongs(yaml_file, text, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        load_config(yaml_file(text))
    assert str(caught.value).startswith(str(yaml_file(text)))


def test_another_plugin_drops_the_options_of_the_one_below(yaml_file):
    file = yaml_file("tracker: {name: csrt, padding: 3}")
    assert load_config(file).tracker.options == {"padding": 3}
    assert load_config(file, tracker="csrt").tracker.options == {"padding": 3}
    assert load_config(file, tracker={"name": "precomputed", "path": "m"}).tracker.options == {"path": "m"}
    assert load_config(file, overrides=["tracker.name=precomputed"]).tracker.options == {}


@pytest.mark.parametrize("first", [True, False])
def test_options_set_beside_a_plugin_belong_to_it_in_any_order(first):
    items = ["tracker.name=precomputed", "tracker.path=masks"]
    config = load_config(overrides=items if first else items[::-1])
    assert config.tracker.options == {"path": "masks"}
    config = load_config(overrides=["tracker.path=masks"], tracker="precomputed")
    assert config.tracker.options == {"path": "masks"}


@pytest.mark.parametrize("text", ["", "# only a comment\n", "{}", "solver:\n  # sigma: 3\n", "---\n...\n"])
def test_empty_file_and_empty_sections_change_nothing(yaml_file, text):
    assert load_config(yaml_file(text)) == load_config()


def test_override_values_are_yaml():
    config = load_config(
        overrides=[
            "camera.intrinsics=[500, 500, 320, 240]",
            "object.flat=true",
            "solver.tau=null",
            "solver.sigma=1e3",
            "solver.name=paper",
        ]
    )
    assert config.camera.intrinsics == (500, 500, 320, 240)
    assert config.object.flat is True
    assert config.solver.tau is None
    assert config.solver.sigma == 1000


def test_yaml_merge_keys_are_plain_data():
    text = "x: &x {a: 1, b: 2}\ny:\n  <<: *x\n  a: 3"
    assert parse_yaml(text, "text")["y"] == {"a": 3, "b": 2}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("- tracker: csrt", "has a list at its top level"),
        ("just words", "has a single value at its top level"),
        ("42", "has a single value"),
        ("tracker: [1", "not valid YAML"),
        ("a: b: c", "not valid YAML"),
        ("\tsolver: 1", "not valid YAML"),
        ("a: 1\n---\nb: 2", "another document"),
        ("[\n" * 3000, "nested too deeply"),
        ("solver: &s {sigma: *s}", "recursive"),
        ("solver: !!python/object/apply:os.system ['touch {marker}']", "never run code"),
        ("solver: !!python/name:os.system", "never run code"),
        ("solver: !mine {sigma: 3}", "'!mine' is refused"),
        ("crop: {size: 64}\ncrop: {margin: 1}", r"'crop' is given twice \(line 2"),
        ("solver: {sigma: 1, sigma: 2}", "'sigma' is given twice"),
        ("1: 2", "key 1 is not text"),
        ("? [a, b]\n: 1", "is not text"),
        ("solver: {name: paper, sigmaa: 3}", r"no setting 'solver.sigmaa'; did you mean 'solver.sigma'\?"),
        ("solvr: {sigma: 3}", r"no setting 'solvr'; did you mean 'solver'\?"),
        ("fov: 30", r"no setting 'fov'; did you mean 'camera.fov'\?"),
        ("solver: {name: paper, weights: {featurs: 3}}", r"did you mean 'solver.weights.features'\?"),
        ("zzz: 30", "no setting 'zzz'; valid are camera, crop, features"),
        ("solver: {name: paper, sigma: lots}", "'solver.sigma' must be a valid number, not 'lots'"),
        ("crop: {size: 4}", "'crop.size' must be greater than or equal to 32, not 4"),
        (
            "solver: {name: paper, silhouette_bias: erod}",
            "'solver.silhouette_bias' must be 'erode', 'soften' or 'none', not 'erod'",
        ),
        ("solver: {weights: {points: .nan}}", "must be a finite number, not nan"),
        ("solver: papre", "'solver.name' must be 'online' or 'paper', not 'papre'"),
        ("solver: {name: 5}", "'solver.name' must be 'online' or 'paper', not 5"),
        ("solver: 3", "'solver' must be a mapping of settings, not 3"),
        ("solver: [1, 2]", "'solver' must be a mapping"),
        ("tracker: [csrt]", "'tracker' must be a mapping"),
        ("tracker: {name: 5}", "'tracker.name' must be a valid string, not 5"),
        ("camera: {intrinsics: [1, 2, 3]}", "camera.intrinsics"),
        ("camera: {intrinsics: [0, 0, 1, 1]}", "positive focal lengths"),
        ("camera: {intrinsics: 500}", "'camera.intrinsics' must be"),
        ("preset: [paper]", "'preset' must be the name"),
        (b"\xff\xfe\x00binary", "not a text file"),
        (b"a: \x00", "not valid YAML"),
    ],
)
def test_bad_yaml_is_one_sentence_with_the_file_and_the_place(yaml_file, tmp_path, text, sentence):
    marker = tmp_path / "ran"
    if isinstance(text, str):
        text = text.replace("{marker}", str(marker))
    with pytest.raises(InputError, match=sentence) as caught:
        load_config(yaml_file(text))
    assert "mine.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not marker.exists()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("solver: null", "'solver' must be a mapping of settings, not null; to change nothing, leave it out"),
        ("features: ~", "'features' must be a mapping of settings, not null"),
        ("camera: null", "'camera' must be a mapping of settings, not null"),
        ("preset: null", "'preset' must be the name of a preset"),
        ("window: " + "{a: " * 100 + "1" + "}" * 100, "nested too deeply"),
        ("[" * 10_000, "nested too deeply"),
        (
            "a: &a [x, x, x, x, x, x, x, x, x, x]\n"
            + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in pairwise("abcdefgh")),
            "its aliases expand to more than 100,000 values",
        ),
        ("# " + "x" * 300_000, "is longer than 256 KiB"),
        ("runtime: {seed: 18446744073709551616}", "'runtime.seed' must be less than 18446744073709551616"),
        ("camera: {intrinsics: [1.0e+308, 1, 1, 1]}", "in pixels, from 1 to a million"),
        ("camera: {intrinsics: [1.0e-300, 1, 1, 1]}", "in pixels, from 1 to a million"),
        ("camera: {intrinsics: [90, 90, 1.0e+300, 1]}", "in pixels, from 1 to a million"),
        ("camera: {fov: .nan}", "'camera.fov' must be a finite number"),
    ],
    ids=lambda value: value[:25],
)
def test_what_means_nothing_or_has_no_end_is_refused(yaml_file, text, sentence):
    with pytest.raises(InputError, match=sentence):
        load_config(yaml_file(text))


@pytest.mark.parametrize("text", ["solver:", "preset:\nfeatures:\n  # name: rgb\n", "solver: {name: online}"])
def test_a_section_with_nothing_behind_its_colon_changes_nothing(yaml_file, text):
    assert load_config(yaml_file(text)) == load_config()
    assert load_config(yaml_file("solver:\n  name: paper\n  weights:\n")).solver == PaperConfig()


def test_nothing_is_chosen_by_an_empty_value():
    for given in ({"overrides": ["tracker="]}, {"overrides": ["solver=null"]}, {"solver": None}):
        with pytest.raises(InputError, match="must be a mapping of settings, not null"):
            load_config(**given)
    with pytest.raises(InputError, match="There is no preset ''"):
        load_config(preset="")


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="this system has no endless file")
def test_an_endless_file_is_not_read_to_its_end():
    with pytest.raises(InputError, match=r"^/dev/zero is longer than 256 KiB"):
        load_config(Path("/dev/zero"))


def test_a_name_that_no_file_can_have_is_refused():
    with pytest.raises(InputError, match=r"cannot be read: File name too long|does not exist"):
        load_config(Path("x" * 300))


def test_ready_files_are_found_by_name_and_a_file_of_ones_own_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert {"csrt-rgb", "flat-object", "precomputed"} == set(ready_files())
    for name in ("flat-object", "flat-object.yaml", "configs/flat-object.yaml"):
        assert load_config(Path(name)).object.flat
    (tmp_path / "flat-object.yaml").write_text("object: {flat: false}")
    assert not load_config(Path("flat-object.yaml")).object.flat
    with pytest.raises(InputError, match=r"flat-objct does not exist .*did you mean 'flat-object'\?"):
        load_config(Path("flat-objct"))


def test_absent_file_and_folder_are_named(tmp_path):
    with pytest.raises(InputError, match=r"absent\.yaml does not exist"):
        load_config(tmp_path / "absent.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        load_config(tmp_path)


@pytest.mark.parametrize("item", ["solver", "=3", "a..b=3", ".a=3", "solver.=3", ""])
def test_malformed_override_says_how_to_write_it(item):
    with pytest.raises(InputError, match=r"section\.key=value"):
        load_config(overrides=[item])


@pytest.mark.parametrize(
    "item", ["crop.size=4", "solver.weights.points=-4", "solver.weights.points=!!python/name:os.system"]
)
def test_bad_override_is_quoted(item):
    with pytest.raises(InputError) as caught:
        load_config(overrides=["crop.size=64", item])
    assert f"overrides: {item}" in str(caught.value)
    assert f"--set {item}" in caught.value.at_the_command_line


def test_unknown_preset_is_answered_with_the_nearest():
    with pytest.raises(InputError, match=r"no preset 'papr'; did you mean 'paper'\?"):
        load_config(preset="papr")
    with pytest.raises(InputError, match="no preset"):
        load_config(preset="../presets/paper")


def test_huge_value_is_shown_short(yaml_file):
    with pytest.raises(InputError) as caught:
        load_config(yaml_file("solver: {points: " + "x" * 10_000 + "}"))
    assert len(str(caught.value)) < 400


def test_schema_covers_presets_and_the_short_form_of_plugins():
    schema = config_schema()
    assert "paper" in schema["properties"]["preset"]["enum"]
    assert {"type": "string"} in schema["$defs"]["PluginChoice"]["anyOf"]
    solvers = schema["properties"]["solver"]["anyOf"]
    assert solvers[0]["enum"] == ["online", "paper"]
    assert [one["$ref"].rpartition("/")[2] for one in solvers[1:]] == ["OnlineConfig", "PaperConfig"]
    assert schema["$defs"]["CropConfig"]["properties"]["size"]["minimum"] == 32


def test_configuration_is_frozen():
    with pytest.raises(ValidationError):
        load_config(preset="paper").crop.size = 64


def test_configs_of_the_repository_are_valid():
    files = sorted((Path(__file__).resolve().parents[2] / "configs").glob("*.yaml"))
    assert len(files) >= 3
    for file in files:
        load_config(file)
