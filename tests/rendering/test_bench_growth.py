"""How the time grows: the exponents, the figures behind them, and their picture."""

from __future__ import annotations

import importlib.util
import json
import sys

import pytest
import torch
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.errors import InputError, OutputError
from tracking3d_bench.speed import benchmark as bench_render
from tracking3d_bench.speed import growth as bench_growth
from tracking3d_bench.speed.growth import exponent, measure_growth
from tracking3d_bench.speed.plot import check_plot, plot_growth
from tracking3d_bench.speed.scene import RenderWorkload
from tracking3d_bench.speed.table import format_growth
from tracking3d_bench.speed.timing import Duration

FEW = {
    "pixels": [{"size": size} for size in (16, 20, 24)],
    "faces": [{"frequency": frequency} for frequency in (1, 2, 3)],
    "frames": [{"frames": frames} for frames in (1, 2, 3)],
    "channels": [{"channels": channels, "texture": 12} for channels in (1, 2, 3)],
}
GROWTH = {
    name: {
        "values": [1, 10, 100],
        "total_ms": {"torch": [10.0, 20.0, 200.0], "numba": [3.0, 9.0, 900.0]},
        "exponent": {"torch": 1.0, "numba": 2.0},
        "linear_or_better": {"torch": True, "numba": False},
    }
    for name in FEW
}
needs_matplotlib = pytest.mark.skipif(
    importlib.util.find_spec("matplotlib") is None, reason="matplotlib, which is optional, is not installed"
)


@pytest.fixture
def few_points(monkeypatch) -> None:
    monkeypatch.setattr(bench_growth, "RANGES", FEW)
    monkeypatch.setattr(bench_render, "peak_memory", lambda name, problem, device, threads: 0.0)


def bench(*arguments: object):
    small = ["--size", 16, "--frames", 1, "--texture", 8, "--repeats", 1, "--no-dense"]
    return CliRunner().invoke(app, ["bench", "render", *map(str, [*small, *arguments])])


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_is_found(power):
    values = [1, 2, 4, 8, 16, 32]
    assert exponent(values, [3 * value**power for value in values]) == pytest.approx(power)


def test_only_the_upper_half_of_the_range_counts():
    # What does not grow hides the rest in the lower half.
    assert exponent([1, 2, 4, 8, 16, 32], [9, 9, 9, 8, 16, 32]) == pytest.approx(1)
    assert exponent([1, 2, 4, 8, 16], [9, 9, 4, 8, 16]) == pytest.approx(1)


def test_points_beside_the_line_are_averaged_in_logarithms():
    # Slopes 0 and 2 between three points at equal distances.
    assert exponent([1, 1, 1, 10, 100, 1000], [1, 1, 1, 1, 1, 100]) == pytest.approx(1)


def test_everything_grows_alone(few_points):
    problem = RenderWorkload(size=16, frames=1, channels=1, texture=8, frequency=2)
    growth = measure_growth(problem, torch.device("cpu"), repeats=1, threads=1)
    assert {name: measured["values"] for name, measured in growth.items()} == {
        "pixels": [256, 400, 576],
        "faces": [20, 80, 180],
        "frames": [1, 2, 3],
        "channels": [1, 2, 3],
    }
    for measured in growth.values():
        for backend in ("torch", "numba"):
            times = measured["total_ms"][backend]
            assert len(times) == 3 and min(times) > 0
            assert measured["exponent"][backend] == pytest.approx(
                exponent(measured["values"], times), abs=1e-3
            )
            linear = measured["exponent"][backend] <= bench_growth.LINEAR
            assert measured["linear_or_better"][backend] == linear


def test_a_busy_moment_spoils_no_point(monkeypatch):
    calls = []

    def busy_in_the_first_pass(problem, device, repeats, threads):
        calls.append(problem)
        slow = 100.0 if calls.count(problem) == 1 else 1.0
        time = slow * problem.size**2
        return {"torch": [Duration(time, time, time)] * repeats}

    monkeypatch.setattr(bench_growth, "RANGES", {"pixels": FEW["pixels"]})
    monkeypatch.setattr(bench_growth, "time_backends", busy_in_the_first_pass)
    growth = measure_growth(RenderWorkload(), torch.device("cpu"), repeats=15, threads=1)
    assert growth["pixels"]["total_ms"] == {"torch": growth["pixels"]["values"]}
    assert growth["pixels"]["exponent"] == {"torch": 1.0}


def test_the_ranges_are_those_that_the_documentation_names():
    ends = {
        name: [getattr(RenderWorkload(**changes[end]), name) for end in (0, -1)]
        for name, changes in bench_growth.RANGES.items()
    }
    assert ends == {
        "pixels": [64**2, 384**2],
        "faces": [320, 9680],
        "frames": [1, 16],
        "channels": [1, 128],
    }


def test_the_command_prints_a_table_the_problem_and_the_exponents(few_points):
    result = bench("--growth", "--channels", 2)
    assert result.exit_code == 0, result.output
    for words in ("torch", "numba", "forward", "backward", "total", "ratio to torch", "peak memory"):
        assert words in result.stdout
    assert (
        "16 x 16 pixels" in result.stdout
        and "2 channels" in result.stdout
        and "8 x 8 texels" in result.stdout
    )
    assert "1 thread;" in result.stdout
    for name in FEW:
        assert name in result.stdout


def test_more_than_linear_is_said(capsys):
    from tracking3d.cli.tables import print_table

    print_table(format_growth(GROWTH))
    rows = [line for line in capsys.readouterr().out.splitlines() if "faces" in line]
    assert len(rows) == 1 and "1.00" in rows[0] and "2.00 (more than linear)" in rows[0]


def test_json_is_one_object_and_nothing_else(few_points):
    result = bench("--json", "--growth")
    report = json.loads(result.stdout)
    assert set(report["growth"]) == set(FEW)
    assert "growth" not in json.loads(bench("--json").stdout)


@pytest.mark.slow
@needs_matplotlib
@pytest.mark.parametrize("name", ["growth.svg", "growth.png", "growth.pdf"])
def test_the_plot_shows_what_was_measured(name, tmp_path):
    plot_growth(GROWTH, tmp_path / name)
    first = (tmp_path / name).read_bytes()
    assert len(first) > 1000
    plot_growth(GROWTH, tmp_path / name)
    assert (tmp_path / name).read_bytes() == first


@needs_matplotlib
def test_a_plot_implies_the_growth(few_points, tmp_path):
    result = bench("--json", "--plot", tmp_path / "growth.svg")
    assert set(json.loads(result.stdout)["growth"]) == set(FEW)
    assert "</svg>" in (tmp_path / "growth.svg").read_text(encoding="utf-8")


def test_a_missing_matplotlib_is_one_sentence_before_anything_is_measured(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(bench_render, "benchmark", None)
    result = bench("--plot", tmp_path / "growth.svg")
    assert result.exit_code == 2
    [line] = result.stderr.splitlines()
    assert line == "error: --plot needs matplotlib; install it with: pip install 'tracking3d[plots]'"


@needs_matplotlib
def test_a_plot_that_cannot_be_written_is_refused_before_anything_is_measured(tmp_path):
    with pytest.raises(InputError, match=r"growth\.xyz has no known format; .*\.svg, \.png or \.pdf"):
        check_plot(tmp_path / "growth.xyz")
    with pytest.raises(OutputError, match="no folder"):
        check_plot(tmp_path / "absent" / "growth.svg")
    check_plot(tmp_path / "growth.svg")


@needs_matplotlib
def test_a_plot_that_cannot_be_written_after_all_is_one_sentence(tmp_path):
    (tmp_path / "growth.svg").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        plot_growth(GROWTH, tmp_path / "growth.svg")
