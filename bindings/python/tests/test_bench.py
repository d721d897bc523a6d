"""`python -m barchan.bench`."""

import json
import subprocess
import sys

import numpy as np
import pytest

import barchan


def bench(*arguments, code=0):
    done = subprocess.run([sys.executable, "-m", "barchan.bench", *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return done


def test_tasks_are_timed(tmp_path):
    done = bench("tasks", "--tasks", "SmoothSurface-lite", "--worlds", "1,2", "--seconds", 0.5, "--json", tmp_path / "bench.json")
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written["barchan"] == barchan.__version__ and [one["worlds"] for one in written["runs"]] == [1, 2]
    for one in written["runs"]:
        assert one["interface"] == "gymnasium" and one["memory_mib"] > 10 and 0 <= one["python_share"] < 0.5
        # Steps a second and real time are two ways to say the same.
        assert one["real_time_factor"] == pytest.approx(one["steps_per_second"] * one["control_interval_s"])
    lines = done.stdout.splitlines()
    assert len(lines) == 4 and lines[0].startswith("| task") and all(len(line) == len(lines[0]) for line in lines)
    failed = bench("tasks", "--tasks", "SmoothSurface-lite", "--backend", "abacus", "--seconds", 0.1, code=1)
    assert "failed" in failed.stdout and "abacus" in failed.stderr
    assert "there is no task 'Smooth'" in bench("tasks", "--tasks", "Smooth", code=1).stderr


def test_tasks_are_timed_without_gymnasium(tmp_path):
    # As a wheel is that was installed without its extras.
    code = "import sys; sys.modules['gymnasium'] = None; from barchan.bench.__main__ import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "tasks", "--one", "--tasks", "SmoothSurface-lite", "--worlds", "2", "--seconds", "0.2"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    one = json.loads(done.stdout)
    assert one["interface"] == "barchan.Environment" and one["steps_per_second"] > 0
    done = subprocess.run([*command[:3], "learn"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and "pip install 'barchan[gym]'" in done.stderr


def test_cma_learns_a_trajectory_in_worlds_of_one_simulation(tmp_path):
    arguments = ["--agent", "cma", "--worlds", 6, "--knots", 2, "--steps", 6, "--budget", 110, "--out", tmp_path]
    done = bench("learn", *arguments)
    summary = json.loads((tmp_path / "summary.json").read_text())
    # Three iterations of six worlds and six steps fit into the budget.
    assert summary["environment_steps"] == 108 and summary["population"] == 6
    rows = np.loadtxt(tmp_path / "curve.csv", delimiter=",", skiprows=1)
    assert rows.shape == (3, 3) and np.all(np.diff(rows[:, 2]) >= 0) and rows[-1, 2] == summary["best"]
    assert (tmp_path / "curve.png").read_bytes()[:4] == b"\x89PNG" and "steps/s" in done.stdout
    best = json.loads((tmp_path / "best.json").read_text())
    assert best["agent"] == "cma" and sum(best["rewards"]) == pytest.approx(summary["best"])
    again = barchan.Environment(best["task"], seed=best["seed"])
    assert [again.step([action])[1][0] for action in best["actions"]] == best["rewards"]


def test_the_hand_written_agent_is_played(tmp_path):
    bench("learn", "--agent", "heuristic", "--steps", 5, "--out", tmp_path)
    assert len(json.loads((tmp_path / "heuristic.json").read_text())["actions"]) == 5
    assert np.isfinite(json.loads((tmp_path / "summary.json").read_text())["heuristic"]["return"])
    assert "KEY=VALUE" in bench("learn", "--set", "randomise", "--out", tmp_path, code=1).stderr
