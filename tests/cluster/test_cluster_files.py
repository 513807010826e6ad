"""The files for clusters are right as far as that can be told without a cluster."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import typer
import yaml

from tracking3d.cli import app

FOLDER = Path(__file__).resolve().parents[2] / "configs/cluster"
BATCH = "batch" in getattr(typer.main.get_command(app), "commands", {})


def test_every_file_is_checked_here():
    assert {path.suffix for path in FOLDER.iterdir() if path.is_file()} == {".yaml", ".sh", ".py"}


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yaml")), ids=lambda path: path.name)
def test_yaml_is_read_and_holds_no_tabs(path):
    text = path.read_text(encoding="utf-8")
    assert "\t" not in text
    assert isinstance(yaml.safe_load(text), dict)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.sh")), ids=lambda path: path.name)
def test_scripts_are_of_the_shell_s_grammar_and_ask_slurm_for_known_things(path):
    subprocess.run(["bash", "-n", path], check=True)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "#!/bin/bash"
    first_command = next(n for n, line in enumerate(lines) if line and not line.startswith("#"))
    asked = {
        line.split("--")[1].split("=")[0]: n for n, line in enumerate(lines) if line.startswith("#SBATCH ")
    }
    assert asked.keys() <= {
        "job-name", "nodes", "ntasks-per-node", "cpus-per-task", "mem", "time", "signal", "requeue", "output",
    }  # fmt: skip
    assert max(asked.values()) < first_command  # Slurm reads no further


def commands() -> list[str]:
    """What the files have `tracking3d` do, names of variables in place of their values."""
    found = []
    for path in sorted(path for path in FOLDER.iterdir() if path.is_file()):
        for line in path.read_text(encoding="utf-8").splitlines():
            if match := re.search(r"tracking3d ((?:batch|run) .*?)(?:'?$| &$)", line.strip()):
                found.append(re.sub(r'"?\$\{?(\w+)[^"\s]*"?', r"\1", match[1]).replace("0,0", "1,1"))
    return found


def test_commands_are_ones_that_the_program_takes():
    found = [shlex.split(line) for line in commands() if "does not fit" not in line]
    assert {line[0] for line in found} == {"run", "batch"}
    program = typer.main.get_command(app)
    for line in found:
        if line[0] == "batch" and not BATCH:
            continue
        command, context, arguments = program, None, line
        while hasattr(command, "commands"):
            context = command.make_context(command.name, arguments, parent=context)
            name, command, arguments = command.resolve_command(context, arguments)
        assert command.make_context(name, arguments, parent=context).params["out"]


def test_the_launcher_s_file_is_valid_by_ray_s_own_schema():
    ray = importlib.util.find_spec("ray")
    if ray is None or ray.origin is None:
        pytest.skip("Ray, whose schema it is, is not installed")
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((Path(ray.origin).parent / "autoscaler/ray-schema.json").read_text(encoding="utf-8"))
    config = yaml.safe_load((FOLDER / "ray-launcher.yaml").read_text(encoding="utf-8"))
    jsonschema.validate(config, schema)
    assert config["head_node_type"] in config["available_node_types"]
    workers = [
        kind for name, kind in config["available_node_types"].items() if name != config["head_node_type"]
    ]
    assert sum(kind["max_workers"] for kind in workers) <= config["max_workers"]
    market = config["available_node_types"][config["head_node_type"]]["node_config"].get(
        "InstanceMarketOptions"
    )
    assert market is None


def test_the_rayjob_s_parts_fit_together():
    job = yaml.safe_load((FOLDER / "rayjob.yaml").read_text(encoding="utf-8"))
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    assert re.fullmatch(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?", job["metadata"]["name"])
    cluster = job["spec"]["rayClusterSpec"]
    [workers] = cluster["workerGroupSpecs"]
    assert workers["minReplicas"] <= workers["replicas"] <= workers["maxReplicas"]
    images = set()
    for group in (cluster["headGroupSpec"], workers):
        assert all(
            isinstance(value, str) for value in group["rayStartParams"].values()
        )  # KubeRay takes text only
        pod = group["template"]["spec"]
        [container] = pod["containers"]
        images.add(container["image"])
        assert {one["name"] for one in container["volumeMounts"]} == {one["name"] for one in pod["volumes"]}
        for name, requested in container["resources"]["requests"].items():
            assert amount(requested) <= amount(container["resources"]["limits"][name])
    assert len(images) == 1
    for path in (word for word in job["spec"]["entrypoint"].split() if word.startswith("/")):
        assert path.startswith("/data/")


def amount(text: str) -> float:
    number, unit = re.fullmatch(r"([\d.]+)(\w*)", text).groups()
    return float(number) * {"": 1, "m": 1e-3, "Mi": 2**20, "Gi": 2**30}[unit]


def test_the_array_s_task_tracks_the_video_of_its_line(tmp_path):
    """Run as Slurm would, with a stand-in for the program."""
    programs = tmp_path / "venv/bin"
    programs.mkdir(parents=True)
    (programs / "activate").write_text(f'export PATH="{programs}:$PATH"\n')
    (programs / "tracking3d").write_text('#!/bin/bash\nprintf "%s\\n" "$@"\n')
    (programs / "tracking3d").chmod(0o755)
    (tmp_path / "list.txt").write_text("clips/a.mp4 1,2,3,4\nmy clips/b c.mov 5,6,7,8\n")
    done = subprocess.run(
        [shutil.which("bash"), FOLDER / "slurm-array.sh", tmp_path / "list.txt", "/runs"],
        env={"VENV": str(tmp_path / "venv"), "SLURM_ARRAY_TASK_ID": "2", "PATH": os.environ["PATH"]},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines() == [
        "run", "my clips/b c.mov", "--box", "5,6,7,8", "--out", "/runs/b c", "--resume", "--quiet",
    ]  # fmt: skip


def test_the_program_for_ray_reads_its_table_the_longest_video_first(tmp_path):
    path = FOLDER / "with-ray.py"
    ast.parse(path.read_text(encoding="utf-8"))
    spec = importlib.util.spec_from_file_location("with_ray", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name, size in (("short.mp4", 3), ("long.mp4", 9)):
        (tmp_path / name).write_bytes(b"0" * size)
    rows = "\n".join(f'{tmp_path / name},"1,2,3,4"' for name in ("short.mp4", "long.mp4"))
    (tmp_path / "videos.csv").write_text(f"video,box\n{rows}\n")
    videos = module.read_videos(tmp_path / "videos.csv")
    assert [Path(video).name for video, _ in videos] == ["long.mp4", "short.mp4"]
    assert videos[0][1] == (1, 2, 3, 4)
