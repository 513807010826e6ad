"""Plug-ins are found, checked and built; a broken one is listed with its reason and stops nobody else."""

from __future__ import annotations

import sys
import types
from importlib import metadata
from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict, Field

from tracking3d.config.models import PluginChoice
from tracking3d.errors import PluginError
from tracking3d.plugins import (
    FEATURES,
    KEYPOINTS,
    TRACKERS,
    VARIABLE,
    PluginInfo,
    build_plugin,
    check_options,
    list_plugins,
    load_plugin,
    plugin_label,
    registration,
)


class GoodTracker:
    class Options(BaseModel):
        model_config = ConfigDict(extra="forbid", frozen=True)
        threshold: float = Field(0.5, ge=0, le=1)
        model: str = "small"

    def __init__(self, options: Options) -> None:
        self.options = options

    @classmethod
    def from_options(cls, options: Options) -> GoodTracker:
        return cls(options)

    def init(self, frame, prompt): ...

    def step(self, frame): ...


class LenientTracker(GoodTracker):
    class Options(BaseModel):
        weight: int = 1


class NeedyTracker(GoodTracker):
    class Options(BaseModel):
        model_config = ConfigDict(extra="forbid")
        path: str


class FailingTracker(GoodTracker):
    @classmethod
    def from_options(cls, options):
        raise RuntimeError("no licence\nfound.")


class WithoutOptions:
    from_options = init = step = lambda self: None


class WithoutStep:
    Options = GoodTracker.Options
    from_options = init = lambda self: None


class TakesName(GoodTracker):
    class Options(BaseModel):
        name: str = ""


class BareEncoder:
    class Options(BaseModel): ...

    @classmethod
    def from_options(cls, options):
        return cls()

    def encode(self, images): ...


class FakePackage:
    def __init__(self, name: str, version: str) -> None:
        self.name, self.version = name, version


@pytest.fixture
def register(monkeypatch):
    """Register classes of this file as installed plug-ins, beside the real ones."""
    module = types.ModuleType("fake_plugins")
    monkeypatch.setitem(sys.modules, "fake_plugins", module)
    real = metadata.entry_points
    fakes: list[metadata.EntryPoint] = []

    def entry_points(*, group: str):
        return [*real(group=group), *(point for point in fakes if point.group == group)]

    monkeypatch.setattr(metadata, "entry_points", entry_points)
    # What was read of the installed packages is kept until their folders change, which they do not do here.
    monkeypatch.setattr(registration, "_packaged_plugins", registration._packaged_plugins.__wrapped__)

    def add(name: str, cls: object, group: str = TRACKERS, package: str = "acme", value: str = "") -> None:
        if cls is not None:
            setattr(module, name, cls)
        point = metadata.EntryPoint(name, value or f"fake_plugins:{name}", group)
        fakes.append(point._for(FakePackage(package, "2.1")))  # type: ignore[attr-defined]

    return add


def found(name: str) -> PluginInfo:
    [info] = [info for info in list_plugins() if info.name == name]
    return info


def test_built_in_plugins_come_through_entry_points():
    infos = {(info.group, info.name): info for info in list_plugins()}
    for key in [(TRACKERS, "csrt"), (TRACKERS, "precomputed"), (FEATURES, "rgb"), (KEYPOINTS, "sift")]:
        assert infos[key].package == "tracking3d"
        assert infos[key].status == "ok", infos[key].reason
        assert infos[key].options["type"] == "object"


def test_installed_plugin_is_listed_and_built(register):
    register("good", GoodTracker)
    info = found("good")
    assert (info.group, info.package, info.version, info.status) == (TRACKERS, "acme", "2.1", "ok")
    assert info.options["properties"]["threshold"]["maximum"] == 1
    assert load_plugin(TRACKERS, "good") is GoodTracker
    tracker = build_plugin(TRACKERS, PluginChoice(name="good", threshold=0.25))
    assert tracker.options == GoodTracker.Options(threshold=0.25)


@pytest.mark.parametrize(
    ("cls", "value", "reason"),
    [
        (None, "not_installed_anywhere:Tracker", "No module named 'not_installed_anywhere'"),
        (None, "fake_plugins:Missing", "Missing"),
        (WithoutOptions, "", "no nested pydantic model Options"),
        (WithoutStep, "", "no method step"),
        (TakesName, "", "a field 'name'"),
        (3, "", "not a class"),
    ],
)
def test_broken_plugin_is_listed_with_its_reason_and_stops_only_who_selects_it(register, cls, value, reason):
    register("bad", cls, value=value)
    info = found("bad")
    assert info.status == "broken"
    assert reason in info.reason
    assert info.options is None
    assert load_plugin(FEATURES, "rgb")
    with pytest.raises(PluginError, match=r"mask tracker 'bad' \(acme 2.1\) is broken"):
        load_plugin(TRACKERS, "bad")


@pytest.mark.parametrize("source", ["raise SystemExit(3)", "1 / 0", "def f(:", "raise KeyError('x')"])
def test_plugin_that_fails_while_it_is_imported_is_broken(monkeypatch, tmp_path, source):
    (tmp_path / "my_failing_tracker.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(VARIABLE, f"{TRACKERS}:mine=my_failing_tracker:Tracker")
    assert found("mine").status == "broken"
    with pytest.raises(PluginError, match="mine"):
        load_plugin(TRACKERS, "mine")


def test_options_without_a_json_schema_make_a_plugin_broken(register):
    class Odd(GoodTracker):
        class Options(BaseModel):
            model_config = ConfigDict(arbitrary_types_allowed=True)
            thing: FakePackage | None = None

    register("odd", Odd)
    assert found("odd").status == "broken"


def test_unknown_name_is_answered_with_the_nearest_and_the_installed():
    with pytest.raises(PluginError, match=r"no mask tracker 'crst' .*csrt.*precomputed.* mean 'csrt'\?"):
        load_plugin(TRACKERS, "crst")
    with pytest.raises(PluginError, match="no feature encoder 'zzzzz'") as caught:
        load_plugin(FEATURES, "zzzzz")
    assert "did you mean" not in str(caught.value)
    with pytest.raises(PluginError, match="'csrt'"):
        load_plugin(TRACKERS, "CSRT")


def test_second_plugin_of_a_name_is_a_duplicate_and_the_built_in_wins(register):
    register("csrt", GoodTracker)
    first, second = sorted((i for i in list_plugins() if i.name == "csrt"), key=lambda i: i.status)
    assert (first.package, first.status) == ("acme", "duplicate")
    assert "tracking3d" in first.reason
    assert (second.package, second.status) == ("tracking3d", "ok")
    assert load_plugin(TRACKERS, "csrt") is not GoodTracker


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"treshold": 0.1}, r"no option 'treshold'; did you mean 'threshold'\?"),
        ({"threshold": "high"}, "'threshold' must be a valid number, not 'high'"),
        ({"threshold": 7}, "'threshold' must be less than or equal to 1, not 7"),
        ({"zzz": 1}, "no option 'zzz'; valid are model, threshold"),
    ],
)
def test_bad_option_names_option_plugin_package_and_version(register, options, sentence):
    register("good", GoodTracker)
    with pytest.raises(PluginError, match=rf"mask tracker 'good' \(acme 2.1\): .*{sentence}"):
        build_plugin(TRACKERS, PluginChoice(name="good", **options))


def test_misspelt_option_is_found_though_the_model_would_ignore_it(register):
    register("lenient", LenientTracker)
    with pytest.raises(PluginError, match=r"did you mean 'weight'\?"):
        check_options(TRACKERS, PluginChoice(name="lenient", wieght=2))
    assert check_options(TRACKERS, PluginChoice(name="lenient", weight=2)) == LenientTracker.Options(weight=2)


def test_missing_option_is_named_but_a_misspelt_one_first(register):
    register("needy", NeedyTracker)
    with pytest.raises(PluginError, match="option 'path' is missing"):
        check_options(TRACKERS, PluginChoice(name="needy"))
    with pytest.raises(PluginError, match=r"no option 'pathh'; did you mean 'path'\?"):
        check_options(TRACKERS, PluginChoice(name="needy", pathh="masks"))


def test_failure_while_building_becomes_one_sentence(register):
    register("failing", FailingTracker)
    with pytest.raises(PluginError, match=r"'failing' .* RuntimeError: no licence found\.$"):
        build_plugin(TRACKERS, PluginChoice(name="failing"))


def test_encoder_without_channels_is_refused_when_built(register):
    register("bare", BareEncoder, group=FEATURES)
    with pytest.raises(PluginError, match="no attribute channels, stride, tau"):
        build_plugin(FEATURES, PluginChoice(name="bare"))


DEVELOPED = """
from __future__ import annotations
from pydantic import BaseModel

class Level(BaseModel):
    value: int = 3

class Mine:
    class Options(BaseModel):
        level: Level = Level()
    def __init__(self, options): self.options = options
    @classmethod
    def from_options(cls, options): return cls(options)
    def init(self, frame, prompt): ...
    def step(self, frame): ...
"""


def test_environment_variable_registers_from_a_module_and_from_a_file(monkeypatch, tmp_path: Path):
    file = tmp_path / "developed_tracker.py"
    file.write_text(DEVELOPED)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(
        VARIABLE, f" {TRACKERS}:by_module=developed_tracker:Mine; {TRACKERS}:by_file={file}:Mine ;"
    )
    for name in ["by_module", "by_file"]:
        assert found(name).package == VARIABLE
        tracker = build_plugin(TRACKERS, PluginChoice(name=name, level={"value": 4}))
        assert tracker.options.level.value == 4
    assert load_plugin(TRACKERS, "by_file") is load_plugin(TRACKERS, "by_file")


@pytest.mark.parametrize("by", ["file", "module"])
def test_the_version_of_a_plugin_under_development_is_that_of_its_file(monkeypatch, tmp_path: Path, by: str):
    file = tmp_path / "versioned_tracker.py"
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(VARIABLE, f"{TRACKERS}:mine={file if by == 'file' else 'versioned_tracker'}:Mine")
    versions = []
    for text in (DEVELOPED, DEVELOPED, DEVELOPED + "# changed"):
        file.write_text(text)
        versions.append(found("mine").version)
    assert versions[0] == versions[1] != versions[2]
    assert plugin_label(TRACKERS, "mine") == f"mask tracker 'mine' ({VARIABLE} {versions[2]})"
    file.unlink()
    assert found("mine").version == ""


def test_a_label_names_kind_package_and_version(register):
    register("good", GoodTracker)
    assert plugin_label(TRACKERS, "good") == "mask tracker 'good' (acme 2.1)"
    with pytest.raises(PluginError, match="did you mean 'good'"):
        plugin_label(TRACKERS, "goood")


def test_plugin_of_the_environment_hides_an_installed_one(monkeypatch, tmp_path: Path):
    file = tmp_path / "replacing_tracker.py"
    file.write_text(DEVELOPED)
    monkeypatch.setenv(VARIABLE, f"{TRACKERS}:csrt={file}:Mine")
    assert load_plugin(TRACKERS, "csrt").__name__ == "Mine"
    assert {i.package: i.status for i in list_plugins() if i.name == "csrt"} == {
        VARIABLE: "ok",
        "tracking3d": "duplicate",
    }


@pytest.mark.parametrize(
    "item", ["nonsense", "trackers:a=b:C", f"{TRACKERS}:=b:C", f"{TRACKERS}:a=b", "=;=:"]
)
def test_malformed_environment_item_is_listed_as_broken(monkeypatch, item):
    monkeypatch.setenv(VARIABLE, item)
    broken = [info for info in list_plugins() if info.package == VARIABLE]
    assert broken
    assert all(i.status == "broken" and "group:name=module:Class" in i.reason for i in broken)
    assert load_plugin(FEATURES, "rgb")


def test_absent_plugin_file_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, f"{TRACKERS}:mine={tmp_path / 'absent.py'}:Mine")
    assert "absent.py does not exist" in found("mine").reason


def test_a_plugin_whose_network_is_absent_needs_weights_if_that_is_asked(monkeypatch, tmp_path):
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path))
    quick, built = ({(one.group, one.name): one for one in list_plugins(build)} for build in (False, True))
    assert quick[TRACKERS, "onnx"].status == "ok"
    assert built[TRACKERS, "onnx"].status == "needs weights"
    assert "models get" in built[TRACKERS, "onnx"].reason
    assert {built[TRACKERS, name].status for name in ("csrt", "flow", "precomputed", "segment")} == {"ok"}
