"""Learners on the tasks, with the packages `cma` and `stable-baselines3` (`pip install 'barchan[learn]'`).

- `cma`: CMA-ES over a trajectory of actions, which a few knots give and straight lines join. Its population is worlds of one simulation that start alike.
- `ppo`, `sac`: a policy from what the agent sees, by Stable-Baselines3, in worlds of one simulation.
- `heuristic`: the task's hand-written agent, for comparison.

Each writes into a folder: `curve.csv` and `curve.png`, `best.json`, which `barchan task replay` plays, `summary.json`, and TensorBoard's files if that is installed.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import barchan
from barchan.bench.settings import add_set, parameters

if TYPE_CHECKING:
    from barchan.envs import TaskVectorEnv

HELP = "Learns a task, and compares with its hand-written agent."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", default="SmoothSurface-lite", help="name of the task")
    parser.add_argument("--agent", choices=["cma", "ppo", "sac", "heuristic"], default="cma")
    parser.add_argument("--budget", type=int, default=200_000, help="environment steps of all worlds together")
    parser.add_argument("--worlds", type=int, default=None, help="worlds of the simulation [40 for cma, which is its population; 16 for others]")
    parser.add_argument("--steps", type=int, default=None, help="control steps of an episode at most [the task's horizon]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--residual", type=float, default=None, help="learn what is added to the hand-written agent: as a share of the limits")
    parser.add_argument("--knots", type=int, default=8, help="cma: knots of the trajectory")
    parser.add_argument("--sigma", type=float, default=0.5, help="cma: how far the first population spreads, of actions from -1 to 1")
    parser.add_argument("--backend", default="cpu")
    parser.add_argument("--adapter", default=None, help="name or number of the GPU")
    parser.add_argument("--device", default="auto", help="ppo, sac: where the network is, for PyTorch")
    add_set(parser)
    parser.add_argument("--out", type=Path, default=None, help="folder [out/learn-TASK-AGENT]")


def run(given: argparse.Namespace) -> int:
    out = given.out or Path("out") / f"learn-{given.task}-{given.agent}"
    out.mkdir(parents=True, exist_ok=True)
    begun = time.perf_counter()
    summary: dict[str, Any] = {"task": given.task, "agent": given.agent, "seed": given.seed, "backend": given.backend}
    heuristic = _heuristic(given, out)
    log = _Log(out, heuristic and heuristic["return"])
    if heuristic is not None:
        summary["heuristic"] = heuristic
        print(f"the hand-written agent: {_words(heuristic)}", flush=True)
    if given.agent != "heuristic":
        summary |= {"cma": _cma, "ppo": _policy, "sac": _policy}[given.agent](given, out, log)
        log.plot(f"{given.task}: {given.agent}")
    summary["seconds"] = time.perf_counter() - begun
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(f"wrote {out}")
    return 0


class _Log:
    """Returns over environment steps: on the terminal, as CSV, as a picture, and for TensorBoard."""

    def __init__(self, out: Path, heuristic: float | None) -> None:
        self.out = out
        self.heuristic = heuristic
        self.rows: list[tuple[int, float, float]] = []
        self._begun = time.perf_counter()
        try:
            from torch.utils.tensorboard import SummaryWriter

            self._board: Any = SummaryWriter(str(out / "tensorboard"))
        except ImportError:
            self._board = None

    def add(self, steps: int, mean: float, best: float, budget: int) -> None:
        self.rows.append((steps, mean, best))
        rate = steps / (time.perf_counter() - self._begun)
        print(f"{steps} of {budget} steps: return {mean:.2f}, best so far {best:.2f}, {rate:.0f} steps/s", flush=True)
        if self._board is not None:
            self._board.add_scalar("return/mean", mean, steps)
            self._board.add_scalar("return/best", best, steps)
            self._board.flush()
        with open(self.out / "curve.csv", "w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([("environment steps", "mean return", "best return so far"), *self.rows])

    def plot(self, title: str) -> None:
        try:
            from matplotlib.figure import Figure
        except ImportError:
            print("matplotlib is missing, so there is no curve.png: pip install 'barchan[plot]'", file=sys.stderr)
            return
        figure = Figure(figsize=(7, 4.5), layout="constrained")
        axes = figure.subplots()
        steps, mean, best = zip(*self.rows) if self.rows else ((), (), ())
        axes.plot(steps, mean, label="mean")
        axes.plot(steps, best, label="best so far")
        if self.heuristic is not None:
            axes.axhline(self.heuristic, color="0.5", linestyle="--", label="hand-written agent")
        axes.set(title=title, xlabel="environment steps", ylabel="return of an episode")
        axes.legend()
        axes.grid(alpha=0.3)
        figure.savefig(self.out / "curve.png", dpi=120)


def _vector(given: argparse.Namespace, worlds: int, mode: str, residual: float | None) -> TaskVectorEnv:
    from barchan.envs import TaskVectorEnv

    return TaskVectorEnv(
        given.task,
        worlds,
        autoreset_mode=mode,
        max_episode_steps=given.steps,
        backend=given.backend,
        adapter=given.adapter,
        residual=residual,
        failures="end",
        **parameters(given),
    )


def _heuristic(given: argparse.Namespace, out: Path) -> dict[str, float] | None:
    """What the hand-written agent comes to on average, in the worlds that a policy is tried in at last; None if there is none."""
    vector = _vector(given, 1 if given.agent == "cma" else given.worlds or (1 if given.agent == "heuristic" else 16), "Disabled", None)
    vector.reset(seed=given.seed)
    try:
        vector.heuristic()
    except barchan.BodyError:
        return None
    return _averages(vector, lambda _: vector.heuristic(), out / "heuristic.json", "heuristic")


def _averages(vector: TaskVectorEnv, act: Callable[[Any], Any], file: Path, agent: str) -> dict[str, float]:
    """Plays an episode in all worlds, which begin, and saves the best one. Averages: of the return, of success, and of what the task tells at the end."""
    seen = vector.worlds.observations()
    returns, alive, last = np.zeros(vector.num_envs), np.ones(vector.num_envs, np.bool_), dict[str, Any]()
    while alive.any():
        seen, rewards, terminated, truncated, told = vector.step(act(seen))
        returns += np.where(alive, rewards, 0.0)
        for name, values in told.items():
            if not name.startswith("_") and values.dtype.kind in "biuf":
                last.setdefault(name, np.zeros(vector.num_envs))[alive] = values[alive]
        alive &= ~(terminated | truncated)
    vector.save_episode(file, world=int(returns.argmax()), agent=agent)
    return {"return": float(returns.mean()), "best": float(returns.max())} | {name: float(values.mean()) for name, values in last.items()}


def _words(averages: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in averages.items())


def episodes(vector: TaskVectorEnv, trajectories: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return of an episode of every world under its trajectory of knots, of shape (worlds, knots, numbers): straight lines join them."""
    worlds, knots, _ = trajectories.shape
    returns, alive = np.zeros(worlds), np.ones(worlds, np.bool_)
    for step in range(vector.max_episode_steps):
        at = step * (knots - 1) / max(vector.max_episode_steps - 1, 1)
        low = min(int(at), max(knots - 2, 0))
        share = at - low
        actions = (1.0 - share) * trajectories[:, low] + share * trajectories[:, min(low + 1, knots - 1)]
        _, rewards, terminated, truncated, _ = vector.step(actions)
        returns += np.where(alive, rewards, 0.0)
        alive &= ~(terminated | truncated)
        if not alive.any():
            break
    return returns


def _cma(given: argparse.Namespace, out: Path, log: _Log) -> dict[str, Any]:
    try:
        import cma
    except ImportError as error:
        raise ImportError("cma is missing: pip install 'barchan[learn]'") from error
    population = given.worlds or 40
    vector = _vector(given, population, "Disabled", given.residual)
    numbers = len(vector.task.action_names)
    options = {"popsize": population, "bounds": [-1, 1], "seed": given.seed + 1, "verbose": -9}
    search = cma.CMAEvolutionStrategy(np.zeros(given.knots * numbers), given.sigma, options)
    steps, best, first = 0, -np.inf, None
    cost = population * vector.max_episode_steps
    while steps == 0 or steps + cost <= given.budget:
        asked = search.ask()
        vector.reset(seed=[given.seed] * population)
        returns = episodes(vector, np.array(asked).reshape(population, given.knots, numbers))
        search.tell(asked, (-returns).tolist())
        steps += int(vector.worlds.steps_taken.sum())
        if returns.max() > best:
            best = float(returns.max())
            vector.save_episode(out / "best.json", world=int(returns.argmax()), agent="cma")
        first = float(returns.mean()) if first is None else first
        log.add(steps, float(returns.mean()), best, given.budget)
    return {"first_mean": first, "last_mean": log.rows[-1][1], "best": best, "environment_steps": steps, "population": population}


def _policy(given: argparse.Namespace, out: Path, log: _Log) -> dict[str, Any]:
    try:
        import torch
        from stable_baselines3 import PPO, SAC
        from stable_baselines3.common.callbacks import BaseCallback
        from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
    except ImportError as error:
        raise ImportError("stable-baselines3 is missing: pip install 'barchan[learn]'") from error
    from barchan.sb3 import Worlds

    # Small networks are slower on several threads, which the worlds need besides.
    torch.set_num_threads(1)
    worlds = given.worlds or 16
    vector = _vector(given, worlds, "SameStep", given.residual)
    environment = VecNormalize(VecMonitor(Worlds(vector)))
    environment.seed(given.seed)
    # Otherwise what all worlds show in a rollout is the same part of an episode.
    environment.set_options({"stagger": True})
    board = str(out / "tensorboard") if log._board is not None else None
    common: dict[str, Any] = {"seed": given.seed, "device": given.device, "tensorboard_log": board}
    if given.agent == "ppo":
        # Small budgets are to see a few updates, too.
        rollout = min(max(2048 // worlds, 32), max(given.budget // (4 * worlds), 2))
        # A residual begins as next to nothing: the hand-written agent is not to be shaken at first.
        policy = {"log_std_init": -1.0 if given.residual is not None else 0.0}
        model: Any = PPO("MlpPolicy", environment, n_steps=rollout, batch_size=min(256, rollout * worlds), policy_kwargs=policy, **common)
    else:
        model = SAC("MlpPolicy", environment, learning_starts=min(10_000, given.budget // 10), train_freq=1, gradient_steps=1, **common)

    class Curve(BaseCallback):
        """Takes down what the episodes since the last time have brought."""

        best = -np.inf
        told = 0

        def _on_step(self) -> bool:
            for world, info in enumerate(self.locals["infos"]):
                if "episode" in info:
                    # The first ones are cut short.
                    if self.begun[world]:
                        self.returns.append(float(info["episode"]["r"]))
                    self.begun[world] = True
            if self.returns and self.num_timesteps - self.told >= given.budget / 200:
                mean, self.told = float(np.mean(self.returns)), self.num_timesteps
                self.best = max(self.best, *self.returns)
                self.returns.clear()
                log.add(self.num_timesteps, mean, self.best, given.budget)
            return True

        def _on_training_start(self) -> None:
            self.returns: list[float] = []
            self.begun = np.zeros(worlds, np.bool_)

    curve = Curve()
    model.learn(given.budget, callback=curve)
    model.save(out / "policy.zip")
    environment.save(str(out / "normalisation.pkl"))
    # What has been learned, without noise, in every world once.
    environment.training = False
    vector.close()
    vector = _vector(given, worlds, "Disabled", given.residual)
    vector.reset(seed=given.seed)
    policy_at_last = _averages(
        vector, lambda seen: model.predict(environment.normalize_obs(seen), deterministic=True)[0], out / "best.json", given.agent
    )
    print(f"the policy without noise: {_words(policy_at_last)}", flush=True)
    return {
        "first_mean": log.rows[0][1] if log.rows else None,
        "last_mean": log.rows[-1][1] if log.rows else None,
        "policy": policy_at_last,
        "environment_steps": model.num_timesteps,
        "worlds": worlds,
    }
