"""Barchan's benchmark tasks as environments of Gymnasium (`pip install 'barchan[gym]'`).

Importing this module registers all of them, each by its name: `gym.make("barchan/SmoothSurface-v0")`, and `gym.make_vec` for worlds of one simulation.

- Actions are from -1 to 1 in each number, which are the task's limits; with `units=True` they are in the units of `barchan.task(name).action_names`. What lies beyond is
  cut off and counted in `info["clipped"]`.
- Observations are float32, without bounds: velocities have none. So the checkers of Gymnasium and Stable-Baselines3 remark on infinite bounds.
- An episode is truncated at the task's horizon. It starts from the seed of `reset(seed=...)`. A `reset()` without one draws a new seed if seeds change what the task is
  (`randomise`), and else begins the same episode again, which is much faster.
- Keyword arguments that are not known here are the task's own parameters, such as `randomise=1.0`.
"""

from __future__ import annotations

import os
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from barchan._core import Environment, registry, task
from barchan.errors import BodyError, DisplayError

try:
    import gymnasium
    from gymnasium.envs.registration import register
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("gymnasium 1.0 or newer is missing: pip install 'barchan[gym]'") from error

__all__ = ["TaskEnv", "TaskVectorEnv", "register_tasks"]


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
        torch: bool | str,
        failures: Literal["raise", "end"],
    ) -> None:
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
        self._torch = _torch_device(torch)
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
            raise gymnasium.error.ResetNeeded("call reset() first: there is no episode yet")
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
        if hasattr(actions, "detach"):
            actions = actions.detach().cpu().numpy()
        given = np.asarray(actions)
        if given.dtype.kind not in "fiu":
            raise TypeError(f"action: its dtype is {given.dtype}; give numbers, float32 for example")
        names = self.task.action_names
        shape = (len(names),) if count is None else (count, len(names))
        if given.shape != shape:
            raise BodyError(f"action: its shape is {given.shape}; give {shape}: {', '.join(names)}")
        given = given.astype(np.float64).reshape(-1, len(names))
        if not np.isfinite(given).all():
            world, number = np.argwhere(~np.isfinite(given))[0]
            where = "" if count is None else f"world {world}: "
            low, high = (self.task.action_low[number], self.task.action_high[number]) if self._units else (-1, 1)
            raise BodyError(f"action: {where}{names[number]} is {given[world, number]}; give a number from {low} to {high}")
        return given

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

    def out(self, array: Any) -> Any:
        """An array as the user wants it."""
        return array if self._torch is None else _as_tensor(array, self._torch)

    def next_seed(self, before: int, random: np.random.Generator) -> int:
        """Seed of an episode for which none is given."""
        return int(random.integers(2**31)) if self.task.ranges or before < 0 else before

    def refuse_pickle(self) -> None:
        if self.worlds is not None:
            raise TypeError(
                "an environment that has begun cannot be pickled or copied; do so before its first reset(), or make one in the process that needs it"
            )


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
        _check_render_mode(render_mode, self.metadata["render_modes"])
        self._played = _Played(
            task,
            parameters,
            backend=backend,
            precision=precision,
            adapter=adapter,
            threads=threads,
            units=units,
            residual=residual,
            torch=torch,
            failures=failures,
        )
        self.task = self._played.task
        self.render_mode = render_mode
        self.action_space = self._played.space()
        self.observation_space = self._played.observation_space()
        self._seed = -1
        self._window: _Window | None = None
        fps = min(60.0, 1.0 / self.task.interval)
        self.metadata = self.metadata | {"render_fps": round(fps) or 1}

    @property
    def worlds(self) -> Environment:
        """The simulated world, a `barchan.Environment`; there is none before the first reset."""
        return self._played.running()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        [seed] = _checked_seeds([seed])
        super().reset(seed=seed)
        own = seed if seed is not None else self._played.next_seed(self._seed, self.np_random)
        observations = self._played.begin([own])
        self._seed = own
        self._show()
        return self._played.out(observations[0]), {"seed": self._seed}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observations, rewards, terminated, truncated, success, info = self._played.step(action, None)
        self._show()
        said = {name: values[0].item() for name, values in info.items()} | {"success": bool(success[0])}
        return self._played.out(observations[0]), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), said

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

    def _show(self) -> None:
        if self.render_mode != "human":
            return
        if self._window is None:
            self._window = _Window(self.task.name, self.metadata["render_fps"])
        self._window.show(self.worlds.render())

    def __getstate__(self) -> dict[str, Any]:
        self._played.refuse_pickle()
        return self.__dict__


class TaskVectorEnv(VectorEnv):
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

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30, "autoreset_mode": AutoresetMode.NEXT_STEP}

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
        _check_render_mode(render_mode, self.metadata["render_modes"])
        for name, count in (("num_envs", num_envs), ("max_episode_steps", max_episode_steps)):
            if count is not None and not (isinstance(count, (int, np.integer)) and count >= 1):
                raise ValueError(f"{name}: {count!r} is none; give a whole number from 1 on")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self._played = _Played(
            task,
            parameters,
            backend=backend,
            precision=precision,
            adapter=adapter,
            threads=threads,
            units=units,
            residual=residual,
            torch=torch,
            failures=failures,
        )
        self.task = self._played.task
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_action_space = self._played.space()
        self.single_observation_space = self._played.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.max_episode_steps = self.task.horizon if max_episode_steps is None else min(max_episode_steps, self.task.horizon)
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        # Steps after which the episode in each world is truncated.
        self._most = np.full(num_envs, self.max_episode_steps, np.int64)
        self._seeds = np.full(num_envs, -1, np.int64)
        self._random: list[np.random.Generator | None] = [None] * num_envs
        self._drawn_from = [-1] * num_envs
        self._ended = np.zeros(num_envs, np.bool_)
        self._terminated = np.zeros(num_envs, np.bool_)

    @property
    def worlds(self) -> Environment:
        """The simulated worlds, a `barchan.Environment`; there are none before the first reset."""
        return self._played.running()

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins new episodes: world w with seed + w, or with the seed of a list; in all worlds, or in those of `options["reset_mask"]`, an array of bool.

        `options["stagger"] = True` truncates these episodes early, each world's at another time, so that worlds are at different times of their episodes from then on: what is
        seen of all of them in a few steps is then like what is seen in an episode.
        """
        if seed is None or isinstance(seed, (int, np.integer)):
            [first] = _checked_seeds([seed])
            seeds = [None if first is None else first + w for w in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: there are {len(seeds)} of them for {self.num_envs} worlds")
        seeds = _checked_seeds(seeds)
        mask = (options or {}).get("reset_mask")
        chosen = np.ones(self.num_envs, np.bool_) if mask is None else np.asarray(mask)
        if chosen.shape != (self.num_envs,) or chosen.dtype != np.bool_ or not chosen.any():
            raise ValueError(f"reset_mask: give an array of {self.num_envs} bools, one of them True at least")
        if not chosen.all():
            # Worlds must be there before some of them can begin anew.
            self._played.running()
        for world in np.flatnonzero(chosen).tolist():
            given = seeds[world]
            if given is not None or self._random[world] is None:
                self._random[world], self._drawn_from[world] = seeding.np_random(given)
            self._seeds[world] = given if given is not None else self._next_seed(world)
        self._ended[chosen] = False
        if chosen.all():
            self._most[:] = self.max_episode_steps
            observations = self._played.begin(self._seeds.tolist())
        else:
            observations = self._again(chosen)
        if (options or {}).get("stagger"):
            count = int(chosen.sum())
            self._most[chosen] = np.maximum(self.max_episode_steps * np.arange(1, count + 1) // count, 1)
        return self._played.out(observations), self._seed_info(chosen)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        anew = self._ended.copy()
        # Worlds whose episode has ended wait.
        observations, rewards, terminated, truncated, success, told = self._played.step(actions, self.num_envs, anew)
        truncated |= self.worlds.steps_taken >= self._most
        info: dict[str, Any] = {}
        present = ~anew
        for name, values in (told | {"success": success}).items():
            info[name], info[f"_{name}"] = values, present.copy()
        if anew.any():
            rewards[anew], success[anew] = 0.0, False
            if self.autoreset_mode is AutoresetMode.DISABLED:
                terminated[anew], truncated[anew] = self._terminated[anew], ~self._terminated[anew]
            else:
                self._draw(anew)
                observations = self._again(anew)
                terminated[anew], truncated[anew] = False, False
                info |= self._seed_info(anew)
        ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            last = np.full(self.num_envs, None, dtype=object)
            for world in np.flatnonzero(ended):
                last[world] = self._played.out(observations[world].copy())
            final = {name: ended.copy() if name.startswith("_") else values.copy() for name, values in info.items()}
            info = {name: values & ~ended if name.startswith("_") else values for name, values in info.items()}
            info |= {"final_obs": last, "_final_obs": ended.copy(), "final_info": final, "_final_info": ended.copy()}
            self._draw(ended)
            observations = self._again(ended)
            info |= self._seed_info(ended)
            self._ended[:] = False
        else:
            self._ended, self._terminated = ended, terminated.copy()
        return self._played.out(observations), self._played.out(rewards), self._played.out(terminated), self._played.out(truncated), info

    @property
    def np_random_seed(self) -> tuple[int, ...]:
        """The seed of each world's generator of seeds, -1 before the first reset, as `SyncVectorEnv` tells it."""
        return tuple(self._drawn_from)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """Each world's generator of seeds, after the first reset."""
        return tuple(random for random in self._random if random is not None)

    def heuristic(self) -> NDArray[np.float32]:
        """The actions of the task's hand-written agent now."""
        return self._played.heuristic()

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of each world."""
        if self.render_mode is None:
            return None
        return tuple(self.worlds.render(world) for world in range(self.num_envs))

    def save_episode(self, path: str | os.PathLike[str], *, world: int = 0, agent: str = "") -> None:
        """Writes what has been done in a world since its last reset, as a file for `barchan task replay`."""
        self.worlds.save_episode(path, world=world, agent=agent)

    def close_extras(self, **_: Any) -> None:
        self._played.worlds = None

    def _next_seed(self, world: int) -> int:
        random = self._random[world]
        assert random is not None
        return self._played.next_seed(int(self._seeds[world]), random)

    def _draw(self, chosen: NDArray[np.bool_]) -> None:
        for world in np.flatnonzero(chosen).tolist():
            self._seeds[world] = self._next_seed(world)

    def _again(self, chosen: NDArray[np.bool_]) -> NDArray[np.float32]:
        worlds = np.flatnonzero(chosen).tolist()
        self._most[worlds] = self.max_episode_steps
        return self.worlds.reset(worlds, self._seeds[worlds].tolist())

    def _seed_info(self, chosen: NDArray[np.bool_]) -> dict[str, Any]:
        return {"seed": np.where(chosen, self._seeds, 0), "_seed": chosen.copy()}

    def __getstate__(self) -> dict[str, Any]:
        self._played.refuse_pickle()
        return self.__dict__


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


def _check_render_mode(mode: str | None, known: list[str]) -> None:
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode: {mode!r} is none of {', '.join(map(repr, known))}, None")


def _checked_seeds(seeds: list[Any]) -> list[int | None]:
    for seed in seeds:
        is_whole = isinstance(seed, (int, np.integer)) and not isinstance(seed, bool)
        if seed is not None and not (is_whole and 0 <= seed < 2**63):
            raise ValueError(f"seed: {seed!r} is none; give whole numbers from 0 to 2^63 - 1")
    # Gymnasium takes no whole numbers of NumPy's.
    return [None if seed is None else int(seed) for seed in seeds]


def _torch_device(torch: bool | str) -> str | None:
    return None if torch is False else "cpu" if torch is True else torch


def _as_tensor(array: Any, device: str) -> Any:
    try:
        import torch
    except ImportError as error:
        raise gymnasium.error.DependencyNotInstalled("torch is missing: pip install torch, or leave torch=True out") from error
    return torch.as_tensor(np.ascontiguousarray(array), device=device)


def register_tasks() -> None:
    """Registers every task that there is now as `barchan/NAME-v0`; those of plugins, too, if it is called again after loading them."""
    for name in registry()["tasks"]:
        spec = f"barchan/{name}-v0"
        if spec not in gymnasium.registry:
            register(spec, entry_point="barchan.envs:TaskEnv", vector_entry_point="barchan.envs:TaskVectorEnv", kwargs={"task": name})


register_tasks()
