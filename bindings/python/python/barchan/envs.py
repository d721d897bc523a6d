"""Barchan's benchmark tasks as environments of Gymnasium (`pip install 'barchan[gym]'`).

Importing this module registers all of them, each by its name: `gym.make("barchan/SmoothSurface-v0")`, and `gym.make_vec` for worlds of one simulation.

- Actions are from -1 to 1 in each number, which are the task's limits; with `units=True` they are in the units of `barchan.task(name).action_names`. What lies beyond is
  cut off and counted in `info["clipped"]`.
- Observations are float32, without bounds: velocities have none. So the checkers of Gymnasium and Stable-Baselines3 remark on infinite bounds.
- An episode is truncated at the task's horizon. It starts from the seed of `reset(seed=...)`. A `reset()` without one draws a new seed if seeds change what the task is
  (`randomise`), and else begins the same episode again, which is much faster.
- Keyword arguments that are not known here are the task's own parameters, such as `randomise=1.0`.
- A task of your own is a class in Python: `SceneVectorEnv`.
"""

from __future__ import annotations

import os
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from barchan._core import Environment, registry, task
from barchan._vector import (
    Step,
    WorldsVectorEnv,
    as_tensor,
    check_count,
    check_machine,
    check_render_mode,
    checked_actions,
    checked_seeds,
    refuse_options,
    refuse_pickle,
    reset_needed,
    torch_device,
)
from barchan.errors import BodyError, DisplayError
from barchan.own import OneWorldEnv, SceneVectorEnv

import gymnasium
from gymnasium.envs.registration import register
from gymnasium.vector import AutoresetMode

__all__ = ["OneWorldEnv", "SceneVectorEnv", "TaskEnv", "TaskVectorEnv", "register_tasks"]


class _Played:
    """What one environment and many have in common: a task, whose worlds are made at the first reset."""

    def __init__(
        self,
        task_name: str | os.PathLike[str],
        parameters: dict[str, Any],
        *,
        backend: str,
        precision: Literal["f32", "f64"],
        adapter: str | int | None,
        threads: int,
        units: bool,
        residual: float | None,
        failures: Literal["raise", "end"],
    ) -> None:
        check_machine(backend, precision, threads)
        self.task = task(task_name, parameters)
        # Of a scene of one's own, its file.
        self._task_name = task_name
        self.worlds: Environment | None = None
        self._options: dict[str, Any] = {"backend": backend, "precision": precision, "adapter": adapter, "threads": threads, "failures": failures}
        self._parameters = parameters
        self._middle = 0.5 * (self.task.action_low + self.task.action_high)
        self._half = 0.5 * (self.task.action_high - self.task.action_low)
        self._units = units
        self._residual = residual
        if residual is not None and not (0.0 < residual <= 1.0 and not units):
            raise ValueError(f"residual: {residual} is no share of the limits; give a number from 0 to 1, and no units=True")
        low, high = (self.task.action_low, self.task.action_high) if units else (-np.ones_like(self._half), np.ones_like(self._half))
        self._low, self._high = low.astype(np.float32), high.astype(np.float32)

    def space(self) -> gymnasium.spaces.Box:
        return gymnasium.spaces.Box(self._low, self._high, dtype=np.float32)

    def observation_space(self) -> gymnasium.spaces.Box:
        return gymnasium.spaces.Box(-np.inf, np.inf, (self.task.observation_size,), dtype=np.float32)

    def begin(self, seeds: list[int]) -> NDArray[np.float32]:
        """New episodes of all worlds."""
        if self.worlds is None:
            self.worlds = Environment(self._task_name, worlds=len(seeds), seed=seeds, parameters=self._parameters, **self._options)
            return self.worlds.observations()
        return self.worlds.reset(seeds=seeds)

    def running(self) -> Environment:
        if self.worlds is None:
            raise reset_needed()
        return self.worlds

    def step(self, actions: Any, count: int | None, waiting: NDArray[np.bool_] | None = None) -> Any:
        """A control step of all worlds, `count` of them, or of the only one."""
        given = self.checked(actions, count)
        worlds = self.running()
        if self._residual is not None:
            given = self.heuristic_in_units() + self._residual * self._half * given
        else:
            is_within = (given >= self._low) & (given <= self._high)
            scaled = given if self._units else self._middle + self._half * given
            # Rounding takes nothing that is in the space beyond the limits.
            given = np.where(is_within, np.clip(scaled, self.task.action_low, self.task.action_high), scaled)
        return worlds.step(given, waiting=None if waiting is None else waiting.tolist())

    def checked(self, actions: Any, count: int | None) -> NDArray[np.float64]:
        """Actions as numbers, a row for each world."""
        names = self.task.action_names
        shape = (len(names),) if count is None else (count, len(names))
        return checked_actions(actions, shape, names, self._low, self._high).reshape(-1, len(names))

    def heuristic_in_units(self) -> NDArray[np.float64]:
        actions = self.running().heuristic()
        if actions is None:
            raise BodyError(f"task '{self.task.name}' has no hand-written agent")
        return actions

    def heuristic(self) -> NDArray[np.float32]:
        """What the hand-written agent would give as actions now."""
        if self._residual is not None:
            return np.zeros((self.running().worlds, len(self._half)), np.float32)
        actions = self.heuristic_in_units()
        if not self._units:
            actions = np.clip((actions - self._middle) / np.where(self._half > 0.0, self._half, 1.0), -1.0, 1.0)
        return actions.astype(np.float32)

    def next_seed(self, before: int, random: np.random.Generator) -> int:
        """Seed of an episode for which none is given."""
        return int(random.integers(2**31)) if self.task.ranges or before < 0 else before


class TaskEnv(gymnasium.Env):
    """One world of a task: see the module's description.

    Parameters
    ----------
    task
        Name of the task (`barchan.registry()["tasks"]`), or path of a scene of one's own (`.toml`) whose `[task]` names one.
    render_mode
        "rgb_array", "human" (a window; needs pygame), or None.
    backend, precision, adapter, threads
        As for `barchan.Simulation`.
    units
        Actions are in the task's units, not from -1 to 1.
    residual
        Actions are added to those of the task's hand-written agent; 1 adds as much as the limits.
    torch
        Observations are tensors of PyTorch: True, or the name of a device. Tensors are taken as actions anyway.
    failures
        "raise" an exception if the world cannot go on, or "end" the episode, with info["failed"].
    parameters
        The task's own.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 30}

    def __init__(
        self,
        task: str | os.PathLike[str],
        *,
        render_mode: Literal["rgb_array", "human"] | None = None,
        backend: str = "cpu",
        precision: Literal["f32", "f64"] = "f32",
        adapter: str | int | None = None,
        threads: int = 0,
        units: bool = False,
        residual: float | None = None,
        torch: bool | str = False,
        failures: Literal["raise", "end"] = "raise",
        **parameters: Any,
    ) -> None:
        check_render_mode(render_mode, self.metadata["render_modes"])
        self._played = _Played(
            task,
            parameters,
            backend=backend,
            precision=precision,
            adapter=adapter,
            threads=threads,
            units=units,
            residual=residual,
            failures=failures,
        )
        self.task = self._played.task
        self.render_mode = render_mode
        self.action_space = self._played.space()
        self.observation_space = self._played.observation_space()
        self._torch = torch_device(torch)
        self._seed = -1
        self._window: _Window | None = None
        fps = min(60.0, 1.0 / self.task.interval)
        self.metadata = self.metadata | {"render_fps": round(fps) or 1}

    @property
    def worlds(self) -> Environment:
        """The simulated world, a `barchan.Environment`; there is none before the first reset."""
        return self._played.running()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        [seed] = checked_seeds([seed])
        refuse_options(options, "leave them out")
        super().reset(seed=seed)
        own = seed if seed is not None else self._played.next_seed(self._seed, self.np_random)
        observations = self._played.begin([own])
        self._seed = own
        self._show()
        return self._out(observations[0]), {"seed": self._seed}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observations, rewards, terminated, truncated, success, info = self._played.step(action, None)
        self._show()
        said = {name: values[0].item() for name, values in info.items()} | {"success": bool(success[0])}
        return self._out(observations[0]), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), said

    def heuristic(self) -> NDArray[np.float32]:
        """The action of the task's hand-written agent now."""
        return self._played.heuristic()[0]

    def render(self) -> NDArray[np.uint8] | None:
        if self.render_mode == "rgb_array":
            return self.worlds.render()
        if self.render_mode == "human":
            self._show()
        return None

    def save_episode(self, path: str | os.PathLike[str], *, agent: str = "") -> None:
        """Writes what has been done since the last reset, as a file for `barchan task replay`."""
        self.worlds.save_episode(path, agent=agent)

    def close(self) -> None:
        if self._window is not None:
            self._window.close()
            self._window = None
        self._played.worlds = None

    def _out(self, observation: NDArray[np.float32]) -> Any:
        return observation if self._torch is None else as_tensor(observation, self._torch)

    def _show(self) -> None:
        if self.render_mode != "human":
            return
        if self._window is None:
            self._window = _Window(self.task.name, self.metadata["render_fps"])
        self._window.show(self.worlds.render())

    def __getstate__(self) -> dict[str, Any]:
        refuse_pickle(self._played.worlds is not None)
        return self.__dict__


class TaskVectorEnv(WorldsVectorEnv):
    """Worlds of a task as environments of one simulation: see the module's description, and `TaskEnv` for other parameters.

    Parameters
    ----------
    task
        Name of the task.
    num_envs
        Number of worlds.
    autoreset_mode
        What happens when an episode has ended: it begins anew with the "NextStep", as Gymnasium's own vector environments do, in the "SameStep" (info["final_obs"] and
        info["final_info"] hold the old one's last), or "Disabled": it waits, with rewards of 0, until you call reset(options={"reset_mask": ...}).
    max_episode_steps
        Truncates episodes before the task's horizon.
    """

    def __init__(
        self,
        task: str | os.PathLike[str],
        num_envs: int = 1,
        *,
        render_mode: Literal["rgb_array"] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        backend: str = "cpu",
        precision: Literal["f32", "f64"] = "f32",
        adapter: str | int | None = None,
        threads: int = 0,
        units: bool = False,
        residual: float | None = None,
        torch: bool | str = False,
        failures: Literal["raise", "end"] = "raise",
        **parameters: Any,
    ) -> None:
        if max_episode_steps is not None:
            check_count("max_episode_steps", max_episode_steps)
        self._played = _Played(
            task,
            parameters,
            backend=backend,
            precision=precision,
            adapter=adapter,
            threads=threads,
            units=units,
            residual=residual,
            failures=failures,
        )
        self.task = self._played.task
        horizon = self.task.horizon if max_episode_steps is None else min(max_episode_steps, self.task.horizon)
        super().__init__(num_envs, self._played.space(), self._played.observation_space(), horizon, render_mode, autoreset_mode, torch)

    @property
    def worlds(self) -> Environment:
        """The simulated worlds, a `barchan.Environment`; there are none before the first reset."""
        return self._played.running()

    def heuristic(self) -> NDArray[np.float32]:
        """The actions of the task's hand-written agent now."""
        return self._played.heuristic()

    def save_episode(self, path: str | os.PathLike[str], *, world: int = 0, agent: str = "") -> None:
        """Writes what has been done in a world since its last reset, as a file for `barchan task replay`."""
        self.worlds.save_episode(path, world=world, agent=agent)

    def close_extras(self, **_: Any) -> None:
        self._played.worlds = None

    def _begin_worlds(self, worlds: list[int], seeds: list[int], options: dict[str, Any]) -> NDArray[np.float32]:
        if len(worlds) == self.num_envs:
            return self._played.begin(seeds)
        return self.worlds.reset(worlds, seeds)

    def _play_worlds(self, actions: Any, waiting: NDArray[np.bool_]) -> Step:
        observations, rewards, terminated, truncated, success, told = self._played.step(actions, self.num_envs, waiting)
        return observations, rewards, terminated, truncated, told | {"success": success}

    def _worlds_taken(self) -> NDArray[np.integer[Any]]:
        return self.worlds.steps_taken

    def _world_seed(self, before: int, random: np.random.Generator) -> int:
        return self._played.next_seed(before, random)

    def _has_worlds(self) -> bool:
        return self._played.worlds is not None

    def _world_picture(self, world: int) -> NDArray[np.uint8]:
        return self.worlds.render(world)


class _Window:
    """A window of pygame."""

    def __init__(self, title: str, fps: int) -> None:
        try:
            import pygame
        except ImportError as error:
            raise gymnasium.error.DependencyNotInstalled("pygame is missing: pip install 'barchan[gym]'") from error
        self._pygame = pygame
        self._title = title
        self._fps = fps
        self._screen: Any = None
        self._clock = pygame.time.Clock()

    def show(self, picture: NDArray[np.uint8]) -> None:
        pygame = self._pygame
        if self._screen is None:
            try:
                pygame.display.init()
                self._screen = pygame.display.set_mode(picture.shape[1::-1])
            except pygame.error as error:
                what = f"no window can be opened for render_mode='human': {error}; use render_mode='rgb_array', or set SDL_VIDEODRIVER=dummy"
                raise DisplayError(what) from error
            pygame.display.set_caption(self._title)
        pygame.event.pump()
        self._screen.blit(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None


def register_tasks() -> None:
    """Registers every task that there is now as `barchan/NAME-v0`; those of plugins, too, if it is called again after loading them."""
    for name in registry()["tasks"]:
        spec = f"barchan/{name}-v0"
        if spec not in gymnasium.registry:
            register(spec, entry_point="barchan.envs:TaskEnv", vector_entry_point="barchan.envs:TaskVectorEnv", kwargs={"task": name})


register_tasks()
