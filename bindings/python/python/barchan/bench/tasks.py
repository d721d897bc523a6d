"""How fast the tasks are: environment steps a second, times real time, memory, and what of a step Python takes."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from typing import Any

import numpy as np

import barchan
from barchan.bench.settings import add_set, parameters

HELP = "Measures every task on every backend, each in a process of its own, with its hand-written agent acting."

COLUMNS = (
    ("task", "task", "{}"),
    ("backend", "backend", "{}"),
    ("worlds", "worlds", "{}"),
    ("particles", "particles a world", "{}"),
    ("steps_per_second", "env steps/s", "{:.1f}"),
    ("real_time_factor", "× real time", "{:.3f}"),
    ("milliseconds", "ms a vector step", "{:.2f}"),
    ("python_share", "Python", "{:.1%}"),
    ("reset_milliseconds", "ms a reset", "{:.0f}"),
    ("memory_mib", "memory [MiB]", "{:.0f}"),
    ("device_memory_mib", "GPU memory [MiB]", "{:.0f}"),
)
"""Of the table: key in the JSON, title, and how it is written."""

WARM_UP = 3
"""Vector steps that are not measured."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tasks", default="*-lite", help="names, separated by commas; '*-lite' stands for all of the small size, '*' for all")
    parser.add_argument("--worlds", default="1", help="numbers of worlds, separated by commas")
    parser.add_argument("--backend", default="cpu", help="backends, separated by commas")
    parser.add_argument("--precision", default="f32")
    parser.add_argument("--adapter", default=None, help="name or number of the GPU")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=5.0, help="how long each is measured")
    parser.add_argument("--json", default=None, metavar="FILE", help="file for the figures")
    parser.add_argument("--markdown", default=None, metavar="FILE", help="file for the table")
    add_set(parser)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)


def run(given: argparse.Namespace) -> int:
    if given.one:
        print(json.dumps(measure(given.tasks, given.backend, int(given.worlds), given)))
        return 0
    runs = []
    for task in _tasks(given.tasks):
        for backend in given.backend.split(","):
            for worlds in given.worlds.split(","):
                one = _in_a_process(task, backend, worlds, given)
                runs.append(one)
                said = one.get("error") or f"{one['steps_per_second']:.1f} env steps/s, {one['real_time_factor']:.3f} × real time"
                print(f"{task}, {backend}, {worlds} worlds: {said}", file=sys.stderr, flush=True)
    text = table(runs)
    print(text)
    if given.markdown:
        with open(given.markdown, "w", encoding="utf-8") as file:
            file.write(text + "\n")
    if given.json:
        machine = {"processor": _processor(), "cores": os.cpu_count(), "system": platform.platform(), "python": platform.python_version()}
        with open(given.json, "w", encoding="utf-8") as file:
            json.dump({"barchan": barchan.__version__, "machine": machine, "runs": runs}, file, indent=1, ensure_ascii=False)
    return 1 if any("error" in one for one in runs) else 0


def measure(task: str, backend: str, worlds: int, given: argparse.Namespace) -> dict[str, Any]:
    """Steps worlds of a task for a while and says what that took."""
    device_before = _device_memory()
    begun = time.perf_counter()
    environment = _Vector(task, worlds, backend, given)
    made = time.perf_counter() - begun
    core = environment.core
    interval = core.task.interval
    steps, taken, simulated, resets, resetting = -WARM_UP, 0.0, core.stepping_seconds, 0, 0.0
    end = time.perf_counter() + given.seconds
    while steps < 1 or time.perf_counter() < end:
        if steps == 0:
            taken, simulated, end = 0.0, core.stepping_seconds, time.perf_counter() + given.seconds
        actions = environment.agent()
        begun = time.perf_counter()
        ended = environment.step(actions)
        taken += time.perf_counter() - begun
        steps += 1
        if ended.any() and time.perf_counter() < end:
            begun = time.perf_counter()
            environment.reset(ended)
            resetting += time.perf_counter() - begun
            resets += int(ended.sum())
    simulated = core.stepping_seconds - simulated
    result = {
        "task": task,
        "backend": backend,
        "precision": core.precision,
        "adapter": _adapter(backend, given.adapter),
        "worlds": worlds,
        "particles": int(core.particle_counts.mean()),
        "control_interval_s": interval,
        "vector_steps": steps,
        "steps_per_second": steps * worlds / taken,
        "real_time_factor": steps * worlds * interval / taken,
        "milliseconds": 1e3 * taken / steps,
        "python_share": 1.0 - simulated / taken,
        "made_seconds": made,
        "interface": environment.interface,
        "memory_mib": _memory(),
    }
    if resets:
        result["reset_milliseconds"] = 1e3 * resetting / resets
    device = _device_memory()
    if device is not None and device_before is not None:
        result["device_memory_mib"] = device - device_before
    return result


class _Vector:
    """Gymnasium's interface if it is installed, or else the bare one."""

    def __init__(self, task: str, worlds: int, backend: str, given: argparse.Namespace) -> None:
        options: dict[str, Any] = {"backend": backend, "precision": given.precision, "adapter": given.adapter, "threads": given.threads}
        try:
            from barchan.envs import TaskVectorEnv

            self.vector: Any = TaskVectorEnv(task, worlds, autoreset_mode="Disabled", **options, **parameters(given))
            self.vector.reset(seed=0)
            self.core = self.vector.worlds
            self.interface = "gymnasium"
        except ImportError:
            self.vector = None
            self.core = barchan.Environment(task, worlds=worlds, parameters=parameters(given), **options)
            self.interface = "barchan.Environment"

    def agent(self) -> Any:
        if self.vector is not None:
            try:
                return self.vector.heuristic()
            except barchan.BodyError:
                return np.zeros(self.vector.action_space.shape, np.float32)
        actions = self.core.heuristic()
        task = self.core.task
        return actions if actions is not None else np.tile(0.5 * (task.action_low + task.action_high), (self.core.worlds, 1))

    def step(self, actions: Any) -> np.ndarray:
        if self.vector is not None:
            _, _, terminated, truncated, _ = self.vector.step(actions)
        else:
            _, _, terminated, truncated, _, _ = self.core.step(actions)
        return terminated | truncated

    def reset(self, ended: np.ndarray) -> None:
        if self.vector is not None:
            self.vector.reset(options={"reset_mask": ended})
        else:
            self.core.reset(np.flatnonzero(ended).tolist())


def table(runs: list[dict[str, Any]]) -> str:
    """The figures as a table of Markdown."""
    columns = [column for column in COLUMNS if any(column[0] in one for one in runs)]
    rows = [[title for _, title, _ in columns]]
    for one in runs:
        if "error" in one:
            rows.append([str(one[key]) if key in one else "–" for key, _, _ in columns])
            rows[-1][-1] = "failed"
        else:
            rows.append([form.format(one[key]) if key in one else "–" for key, _, form in columns])
    widths = [max(len(row[i]) for row in rows) for i in range(len(columns))]
    lines = ["| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths)) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])


def _tasks(wanted: str) -> list[str]:
    known = barchan.registry()["tasks"]
    if wanted in ("*", "*-lite"):
        return [name for name in known if wanted == "*" or name.endswith("-lite")]
    for name in wanted.split(","):
        if name not in known:
            raise barchan.UnknownNameError(f"--tasks: there is no task '{name}'; there are {', '.join(known)}")
    return wanted.split(",")


def _in_a_process(task: str, backend: str, worlds: str, given: argparse.Namespace) -> dict[str, Any]:
    command = [sys.executable, "-m", "barchan.bench", "tasks", "--one", "--tasks", task, "--backend", backend, "--worlds", worlds]
    command += ["--seconds", str(given.seconds), "--precision", given.precision, "--threads", str(given.threads)]
    for one in given.set:
        command += ["--set", one]
    if given.adapter is not None:
        command += ["--adapter", given.adapter]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return json.loads(done.stdout.splitlines()[-1])
    said = done.stderr.strip().splitlines()
    return {"task": task, "backend": backend, "worlds": int(worlds), "error": said[-1] if said else f"exit status {done.returncode}"}


def _memory() -> float:
    """The most memory that this process has had [MiB]."""
    try:
        import resource
    except ImportError:
        return float("nan")
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 2**20 if sys.platform == "darwin" else most / 2**10


def _device_memory() -> float | None:
    """Memory of all NVIDIA GPUs that is in use [MiB]; None without any."""
    command = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
        return float(sum(float(line) for line in done.stdout.split()))
    except (OSError, subprocess.SubprocessError, ValueError):
        return None


def _adapter(backend: str, wanted: str | None) -> str | None:
    names = barchan.adapters(backend)
    if not names:
        return None
    return names[int(wanted)] if wanted is not None and wanted.isdigit() else wanted or names[0]


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()
