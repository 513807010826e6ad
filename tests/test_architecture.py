"""The house: imports point down only, and rooms stay small."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "tracking3d"
BENCH = PACKAGE.parent / "plugins/tracking3d-bench"
LONGEST_MODULE = 700
LONGEST_FUNCTION = 80
MOST_PARAMETERS = 12

# Today's figures, to be lowered as steps of the house land, and raised by nobody without a reason.
DEEPEST_INHERITANCE = 2  # of errors; 1 without them
MOST_IMPORT_LINES = 0.08
"""Share of all lines."""

SMALL_MODULE = 120
"""Lines below which a module that one other of its room alone imports belongs into that one."""

MOST_LONE_SMALL_MODULES = 21
MODULES_IN_A_FOLDER = 25
FULLER_FOLDERS = {"export": 31}
"""Folders that hold more today, with their numbers; `export` has a file for each format."""

ROOM_LINES = {
    "__main__": 50,
    "batch": 2150,
    "cli": 4650,
    "config": 1450,
    "engines": 900,
    "errors": 50,
    "estimation": 14500,  # kernels of the joint fit; carried masks; photos merged; poses by points; live landmarks
    "export": 2550,
    "features": 1500,  # the protocol of keypoint detectors, and a network for it
    "frames": 150,
    "geometry": 2100,  # poses keep their matrices; the loop of Levenberg and Marquardt
    "modules": 450,
    "pipeline": 6950,  # what is tried when frames are lost; carried masks; photos are segmented by themselves
    "plugins": 850,  # the group of keypoint detectors
    "points": 3650,  # the fit of one pose in a kernel
    "reconstruction": 3900,  # total variation in a kernel
    "rendering": 3800,  # depth without faces
    "results": 6800,
    "runtime": 1200,  # logistic regressions from files
    "scene": 350,
    "testing": 1100,
    "trackers": 6400,  # holes of masks; frames that are skipped; cameras that stand still
    "ui": 5150,  # sentences of results and cli
    "video": 2550,
}
"""Lines that a room may have: today's, in fifties. Who needs more raises it in the same commit, and says why."""

LOOSE_MODULES = {"__init__", "__main__", "errors", "frames"}
"""All that the root holds besides rooms: what everybody raises and what travels through all rooms."""

# Who lives on which floor; a module may import from lower floors and from its own room only.
# Rooms of one floor may use each other, but never in circles.
FLOORS = [
    {"engines", "errors", "frames"},
    {"config", "geometry", "points", "rendering", "runtime", "scene"},
    {"features", "plugins", "trackers", "video"},
    {"estimation", "modules"},
    {"results"},
    {"export", "reconstruction", "testing", "ui"},
    {"pipeline"},
    {"batch"},
    {"cli", "__main__"},
]
"""``tracking3d/__init__.py`` is the front door: it imports from anywhere, and nobody imports from it."""

ONLINE = PACKAGE / "estimation" / "online"
SEGMENTATION = PACKAGE / "estimation" / "segmentation"
ONLINE_FLOORS = [
    {"features"},
    {"optimization"},
    {"state"},
    {"mapping"},
    {"initialization"},
    {"pose_tracking"},
    {"masks"},
    {"relocalization"},
    {"atlas", "initializer", "mapper", "refiner", "tracker"},
    {"solver"},
    {"known_object"},
]
"""The rooms of the solver ``online``, from the ground: each imports from itself and from lower floors only.

The components of `OnlineSolver` share a floor, so that they do not know one another."""


def floor(room: str, floors: list[set[str]] = FLOORS) -> int:
    for height, rooms in enumerate(floors):
        if room in rooms:
            return height
    raise AssertionError(f"The room {room} has no floor yet: give it one in {Path(__file__).name}")


@cache
def modules() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def online_imports() -> list[tuple[Path, str, str]]:
    """For each import between rooms of the solver ``online``: the module, its room and the room that it imports."""
    home = module_name(ONLINE).split(".")
    found = []
    for path in sorted(ONLINE.rglob("*.py")):
        own = path.relative_to(ONLINE).parts[0].removesuffix(".py")
        for name in imported_modules(path):
            parts = name.split(".")
            if parts[: len(home)] == home and len(parts) > len(home) and parts[len(home)] != own:
                found.append((path, own, parts[len(home)]))
    return found


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def module_of(name: str) -> str:
    """The module that an imported name is, or is in."""
    path = PACKAGE.parent.joinpath(*name.split("."))
    return name if path.with_suffix(".py").is_file() or path.is_dir() else name.rpartition(".")[0]


@cache
def imported_modules(path: Path) -> set[str]:
    """Full names of what a module imports from the package, within functions too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] == "tracking3d"}


def test_the_root_holds_rooms_and_what_everybody_shares():
    assert {path.stem for path in PACKAGE.glob("*.py")} == LOOSE_MODULES


def test_every_floor_holds_rooms_that_exist():
    rooms = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    assert set().union(*FLOORS) == rooms | LOOSE_MODULES - {"__init__"}
    online = {
        path.stem for path in ONLINE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    assert set().union(*ONLINE_FLOORS) == online - {"__init__"}


def test_a_module_imports_from_below_only():
    above = []
    for path in modules():
        own = room_of(path)
        for name in imported_modules(path):
            room = name.split(".")[1] if "." in name else ""
            if not (PACKAGE / room).is_dir() and not (PACKAGE / f"{room}.py").is_file():
                continue  # a name of the front door, such as the version
            if room != own and floor(room) > floor(own):
                above.append(f"{path} (floor {floor(own) + 1}) imports {name} from above")
    assert not above


def test_a_room_of_the_online_solver_imports_from_below_only():
    imports = online_imports()
    assert imports
    above = [
        f"{path} imports {room} from above"
        for path, own, room in imports
        if floor(room, ONLINE_FLOORS) >= floor(own, ONLINE_FLOORS)
    ]
    assert not above


def test_rooms_of_one_floor_do_not_import_each_other_in_circles():
    uses: dict[str, set[str]] = {}
    for path in modules():
        rooms = {name.split(".")[1] for name in imported_modules(path) if "." in name}
        uses.setdefault(room_of(path), set()).update(rooms & set().union(*FLOORS) - {room_of(path)})
    reached = {room: set(used) for room, used in uses.items()}
    for _ in reached:
        reached = {
            room: used.union(*(reached.get(other, set()) for other in used)) for room, used in reached.items()
        }
    assert not [room for room, used in reached.items() if room in used]


def test_modules_do_not_import_each_other_in_circles():
    """Neither at module level nor within functions nor for types alone."""
    uses = {module_name(path): {module_of(name) for name in imported_modules(path)} for path in modules()}
    circles = []
    for module, used in uses.items():
        reached, ahead = set(), list(used)
        while ahead:
            other = ahead.pop()
            if other not in reached and other in uses:
                reached.add(other)
                ahead += uses[other]
        if module in reached:
            circles.append(module)
    assert not circles


def test_one_name_is_one_class():
    """A Protocol and its only implementation may pair; the nested ``Options`` of plug-ins do not count."""
    homes: dict[str, list[bool]] = {}
    for path in modules():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                protocol = any(ast.unparse(base).startswith("Protocol") for base in node.bases)
                homes.setdefault(node.name, []).append(protocol)
    assert not [
        name for name, protocols in homes.items() if len(protocols) > 1 and sorted(protocols) != [False, True]
    ]


@pytest.mark.parametrize("room", ["geometry", "rendering"])
def test_geometry_and_rendering_know_nothing_of_video_or_tracking(room):
    allowed = {"geometry", "rendering", "errors"}
    for path in (PACKAGE / room).rglob("*.py"):
        if path.parent.name != "calibration":  # reads pictures of a board, frame by frame
            assert {name.split(".")[1] for name in imported_modules(path)} <= allowed, path


def test_segmentation_does_without_solvers_and_runs():
    for path in SEGMENTATION.rglob("*.py"):
        others = {name for name in imported_modules(path) if not name.startswith(module_name(SEGMENTATION))}
        rooms = {name.split(".")[1] for name in others}
        assert rooms <= {"frames", "geometry", "rendering", "runtime", "scene", "trackers"}, path


def test_points_are_followed_by_surface_and_images_alone():
    for path in (PACKAGE / "points").rglob("*.py"):
        rooms = {name.split(".")[1] for name in imported_modules(path)}
        assert rooms <= {
            "bundle_adjustment",
            "errors",
            "geometry",
            "points",
            "rendering",
            "runtime",
            "scene",
        }, path


def test_scenes_are_views_and_surfaces_alone():
    for path in (PACKAGE / "scene").rglob("*.py"):
        rooms = {name.split(".")[1] for name in imported_modules(path)}
        assert rooms <= {"errors", "frames", "geometry", "rendering", "scene"}, path


def test_the_solvers_are_tenants_that_never_import_each_other():
    rooms = {
        folder.name for folder in (PACKAGE / "estimation").iterdir() if (folder / "__init__.py").is_file()
    } - {SEGMENTATION.name}
    assert len(rooms) > 1
    for tenant in rooms:
        for path in (PACKAGE / "estimation" / tenant).rglob("*.py"):
            for name in imported_modules(path):
                parts = name.split(".")
                assert parts[:2] != ["tracking3d", "estimation"] or parts[2] not in rooms - {tenant}, path


def test_the_package_does_without_what_measures_it():
    scripts = {path.stem for path in (BENCH / "benchmarks").glob("*.py")}
    assert scripts
    for path in modules():
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add(str(node.module).partition(".")[0])
        assert not names & {"benchmarks", "tracking3d_bench", *scripts}, path


def test_no_module_is_longer_than_a_reader_keeps_in_mind():
    assert not [path for path, lines in lengths().items() if lines > LONGEST_MODULE]


def test_functions_are_short_and_take_few_parameters():
    """A command of the CLI may take more parameters, and so may `track`, its twin in Python: each is an option."""
    checked, faults, free = 0, [], {*commands(), "tracking3d.pipeline.track.track"}
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            checked += 1
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            arguments = node.args
            parameters = len(arguments.posonlyargs) + len(arguments.args) + len(arguments.kwonlyargs)
            if lines > LONGEST_FUNCTION:
                faults.append(f"{path}: {node.name} has {lines} lines")
            if parameters > MOST_PARAMETERS and f"{module_name(path)}.{node.name}" not in free:
                faults.append(f"{path}: {node.name} has {parameters} parameters")
    assert checked
    assert not faults


@cache
def commands() -> set[str]:
    """Full names of the functions that the CLI registers: ``app.command(...)(module.function)``."""
    found = set()
    for path in (PACKAGE / "cli").rglob("__init__.py"):
        imported = {name.rpartition(".")[2]: name for name in imported_modules(path)}
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Call(
                    func=ast.Call(func=ast.Attribute(attr="command")),
                    args=[ast.Attribute(value=ast.Name(id=module), attr=function)],
                ) if module in imported:
                    found.add(f"{imported[module]}.{function}")
    assert found
    return found


@cache
def lengths() -> dict[Path, int]:
    """Of every module, in lines."""
    return {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules()}


def test_a_room_keeps_to_its_budget_of_lines():
    rooms: dict[str, int] = {}
    for path, lines in lengths().items():
        rooms[room_of(path)] = rooms.get(room_of(path), 0) + lines
    assert rooms.keys() == ROOM_LINES.keys()
    assert not {
        room: f"{lines} of {ROOM_LINES[room]}" for room, lines in rooms.items() if lines > ROOM_LINES[room]
    }
    loose = {room: lines for room, lines in rooms.items() if ROOM_LINES[room] - lines >= 500}
    assert not loose, "lower the budgets of these rooms"


def test_imports_are_a_small_share_of_the_lines():
    imports = sum(
        (node.end_lineno or node.lineno) - node.lineno + 1
        for path in modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
    )
    assert 0 < imports <= MOST_IMPORT_LINES * sum(lengths().values())


def test_small_modules_that_one_sibling_alone_imports_get_no_more():
    """Formats, commands, kernels and plug-ins that are such modules are among the number."""
    users: dict[str, set[str]] = {}
    for path in modules():
        for used in {module_of(name) for name in imported_modules(path)}:
            users.setdefault(used, set()).add(module_name(path))
    lone = [
        path
        for path, lines in lengths().items()
        if lines < SMALL_MODULE
        and path.name != "__init__.py"
        and len(found := users.get(module_name(path), set())) == 1
        and {user.split(".")[1] for user in found} == {room_of(path)}
    ]
    assert len(lone) <= MOST_LONE_SMALL_MODULES, lone


def test_a_folder_holds_few_modules():
    folders: dict[str, int] = {}
    for path in modules():
        folder = path.parent.relative_to(PACKAGE).as_posix()
        folders[folder] = folders.get(folder, 0) + 1
    assert not {
        folder: count
        for folder, count in folders.items()
        if count > FULLER_FOLDERS.get(folder, MODULES_IN_A_FOLDER)
    }


def test_no_class_is_a_slice_of_a_long_line_of_ancestors():
    """Classes of other packages, and so errors and settings, end the line."""
    bases: dict[str, list[str]] = {}
    for path in modules():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                bases[node.name] = [ast.unparse(base).partition("[")[0] for base in node.bases]

    def depth(name: str) -> int:
        return max((1 + depth(base) for base in bases[name] if base in bases), default=0)

    deepest = max(bases, key=depth)
    assert depth(deepest) <= DEEPEST_INHERITANCE, deepest
