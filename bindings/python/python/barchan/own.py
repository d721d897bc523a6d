"""Tasks of your own, written in Python, as environments of Gymnasium (`pip install 'barchan[gym]'`).

A subclass of `SceneVectorEnv` says what actions do in a scene, what is seen and what is rewarded. Worlds of one simulation, episodes, seeds, automatic resets, failures and
pictures are seen to.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from barchan._core import Simulation, State, View
from barchan._vector import (
    Seen,
    Step,
    WorldsVectorEnv,
    as_array,
    check_count,
    check_machine,
    checked_actions,
    checked_seeds,
    reset_needed,
    row_of,
)
from barchan.errors import BodyError, SimulationError

import gymnasium
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

__all__ = ["OneWorldEnv", "SceneVectorEnv"]

# Share of a control step by which the time of a world that has taken it may be off.
_ROUNDING = 1e-6
# What is told of every control step or episode anyway.
_TOLD = ("clipped", "failed", "seed", "final_obs", "final_info")


class SceneVectorEnv(WorldsVectorEnv):
    """Worlds of a scene as environments whose task a subclass says.

    In a control step `act` gives commands, all worlds go on for `interval`, and `observe`, `reward`, `terminated` and `info` are asked, in this order, for all worlds: what they
    return has a row for each. They read `self.simulation`, a `barchan.Simulation`, whose `robot_arrays`, `body_arrays` and `height_arrays` have a row for each world, too. An episode begins with
    `draw`, `begin` and `observe`, each for the worlds that begin one.

    If one of them raises, a world cannot go on, or Ctrl-C comes, all episodes are broken off: worlds take no step before they are reset.

    Parameters
    ----------
    scene
        Name of a built-in scene, path of a scene's file, or a dict, as for `barchan.Simulation`.
    num_envs
        Number of worlds.
    interval
        Simulated time of a control step [s].
    max_episode_steps
        Control steps after which an episode is truncated.
    action_space
        Of one world: a `Box`, `Discrete`, `MultiDiscrete` or `MultiBinary`. What lies beyond the limits of a `Box` is cut off, and `info["clipped"]` counts it.
    observation_space
        A `Box`, of one world, or a `Dict` of them: `observe` returns a dict of arrays by the same names then.
    decimation
        So many times in a control step `act` is called, each for its share of the interval: for torques that follow what joints do.
    overrides
        Changes to the scene, as for `barchan.Simulation`: a dict, or one for each world.
    render_mode, picture
        "rgb_array" draws the whole "page", or the "ground" without title, scales and cut.
    autoreset_mode
        "NextStep", "SameStep" or "Disabled", as for `TaskVectorEnv`.
    backend, precision, adapter, threads
        As for `barchan.Simulation`.
    torch
        What is returned are tensors of PyTorch: True, or the name of a device. Tensors are taken as actions anyway.
    failures
        "raise" an exception if a world cannot go on, or "end" its episode alone, with a reward of 0 and `info["failed"]`. `failures` says why, either way.
    """

    def __init__(
        self,
        scene: str | os.PathLike[str] | dict[str, Any],
        num_envs: int = 1,
        *,
        interval: float,
        max_episode_steps: int,
        action_space: spaces.Space[Any],
        observation_space: spaces.Box | spaces.Dict,
        decimation: int = 1,
        overrides: dict[str, Any] | Sequence[dict[str, Any]] | None = None,
        render_mode: Literal["rgb_array"] | None = None,
        picture: Literal["page", "ground"] = "page",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        backend: str = "cpu",
        precision: Literal["f32", "f64"] = "f32",
        adapter: str | int | None = None,
        threads: int = 0,
        torch: bool | str = False,
        failures: Literal["raise", "end"] = "raise",
    ) -> None:
        if not (isinstance(interval, (int, float, np.number)) and np.isfinite(interval) and interval > 0.0):
            raise ValueError(f"interval: {interval!r} is no time of a control step; give seconds above 0")
        if not isinstance(action_space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            raise TypeError(f"action_space: it is a {type(action_space).__name__}; give a Box, Discrete, MultiDiscrete or MultiBinary of gymnasium.spaces")
        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        other = next((name for name, part in parts.items() if not isinstance(part, spaces.Box)), None)
        if not parts or other is not None:
            what = f"its part {other!r}" if other else "it"
            kind = type(parts[other] if other is not None else observation_space).__name__
            raise TypeError(f"observation_space: {what} is a {kind}; give a Box of gymnasium.spaces, or a Dict of them")
        if failures not in ("raise", "end"):
            raise ValueError(f"failures: {failures!r} is neither 'raise' nor 'end'")
        if picture not in ("page", "ground"):
            raise ValueError(f"picture: {picture!r} is neither 'page' nor 'ground'")
        check_machine(backend, precision, threads)
        check_count("decimation", decimation)
        super().__init__(num_envs, action_space, observation_space, max_episode_steps, render_mode, autoreset_mode, torch)
        each = [overrides or {}] * num_envs if isinstance(overrides, (dict, type(None))) else overrides
        if not isinstance(each, (list, tuple)) or len(each) != num_envs or not all(isinstance(one, dict) for one in each):
            raise ValueError(f"overrides: give a dict, or a list of {num_envs} of them, one for each world")
        self.interval = float(interval)
        self.decimation = decimation
        self.metadata = self.metadata | {"render_fps": round(min(60.0, 1.0 / interval)) or 1}
        self.failures: list[str | None] = [None] * num_envs
        """Why each world's last episode that failed did so."""
        self.options: dict[str, Any] = {}
        """Options of the `reset` that has begun the newest episode, but for those that are known: for `draw` and `begin`. Automatic resets have none."""
        self.__scene = copy.deepcopy(scene)
        self.__overrides = [dict(one) for one in each]
        self.__is_alike = isinstance(overrides, (dict, type(None)))
        self.__machine: dict[str, Any] = {"backend": backend, "precision": precision, "adapter": adapter, "threads": threads}
        self.__part = picture
        self.__ends = failures == "end"
        self.__simulation: Simulation | None = None
        # Where all episodes begin, if all begin alike.
        self.__start: State | None = None
        self.__generators: list[np.random.Generator] = [np.random.default_rng(0)] * num_envs
        self.__is_random = False
        self.__keys: frozenset[str] | None = None
        self.__views: dict[int, View] = {}
        self.__steps = np.zeros(num_envs, np.int64)
        self.__clipped = np.zeros(num_envs, np.int64)
        self.__waiting = np.zeros(num_envs, np.bool_)
        # Worlds whose episode an exception has broken off.
        self.__broken = np.zeros(num_envs, np.bool_)

    @property
    def simulation(self) -> Simulation:
        """The simulated worlds; there are none before the first reset."""
        if self.__simulation is None:
            raise reset_needed()
        return self.__simulation

    @property
    def steps_taken(self) -> NDArray[np.int64]:
        """Control steps that each world's episode has taken, (num_envs,)."""
        return self.__steps.copy()

    @property
    def waiting(self) -> NDArray[np.bool_]:
        """Worlds that take no step in this control step, (num_envs,): their episode has ended, or they could not go on. What `act` does to them is done all the same."""
        return self.__waiting.copy()

    def random(self, world: int) -> np.random.Generator:
        """The generator of an episode's random numbers, which begins from its seed. Whoever uses it gets a new seed with each reset that gives none."""
        self.__is_random = True
        return self.__generators[world]

    # What a subclass says.

    def draw(self, random: np.random.Generator, world: int) -> dict[str, Any]:
        """What differs in a new episode's scene: overrides, the same keys each time.

        Without it worlds begin alike, with a copy, unless each has overrides of its own. With it scenes are seeded anew, by the episode's seed unless this gives one (`"seed"`).
        """
        return {}

    def begin(self, worlds: list[int]) -> None:
        """Prepares new episodes in these worlds, which are at the scene's start: puts bodies elsewhere, sets back what the task remembers."""

    def act(self, actions: NDArray[Any]) -> None:
        """Gives the commands of a control step. Actions have the shape (num_envs, ...) and are within the space, float64 for a `Box`."""
        raise NotImplementedError(f"{type(self).__name__} has no act(actions)")

    def observe(self, worlds: list[int]) -> Any:
        """What is seen of these worlds, an array with a row for each, or arrays by name: of all behind a control step, and of those that begin an episode."""
        raise NotImplementedError(f"{type(self).__name__} has no observe(worlds)")

    def reward(self, actions: NDArray[Any]) -> Any:
        """Reward of the control step that has just been taken, (num_envs,)."""
        raise NotImplementedError(f"{type(self).__name__} has no reward(actions)")

    def terminated(self) -> Any:
        """Does the episode end here by what has happened? Bools, (num_envs,). What lasts too long is truncated without asking."""
        return np.zeros(self.num_envs, np.bool_)

    def info(self) -> dict[str, Any]:
        """Numbers to tell by name, each (num_envs,)."""
        return {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        if self.__simulation is None:
            raise reset_needed()
        if self.__broken.any():
            worlds = ", ".join(map(str, np.flatnonzero(self.__broken)))
            raise ValueError(f"worlds {worlds}: a control step or a reset was interrupted half way; reset() them first")
        given = self.__checked(actions)
        self.__broken[:] = True
        stepped = super().step(given)
        self.__broken[:] = False
        return stepped

    def close_extras(self, **_: Any) -> None:
        self.__simulation = self.__start = None
        self.__views.clear()

    # What the episodes ask for.

    def _begin_worlds(self, worlds: list[int], seeds: list[int], options: dict[str, Any]) -> Seen:
        self.__broken[worlds] = True
        self.options = options
        for world, seed in zip(worlds, seeds, strict=True):
            self.__generators[world] = np.random.default_rng(seed)
        drawn = [self.__drawn_scene(world) for world in worlds]
        draws = _is_own(self.draw, SceneVectorEnv.draw)
        has_seed = any("seed" in given for given in (*drawn, *self.__overrides))
        own_seeds = seeds if draws and not has_seed else None
        if self.__simulation is None:
            overrides = [before | more for before, more in zip(self.__overrides, drawn, strict=True)]
            self.__simulation = Simulation(self.__scene, worlds=self.num_envs, seed=own_seeds, overrides=overrides, **self.__machine)
            if self.__is_alike and not draws:
                self.__start = self.__simulation.state()
                self.__simulation.restore(self.__start)
        elif self.__start is not None:
            # Nothing is seeded then.
            self.__simulation.restore(self.__start, worlds=worlds)
        else:
            self.__simulation.reset(worlds, own_seeds, overrides=drawn if self.__keys else None)
        self.__steps[worlds], self.__clipped[worlds] = 0, 0
        for world in worlds:
            self.__views.pop(world, None)
        self.begin(worlds)
        seen = self.__observed(worlds)
        self.__broken[worlds] = False
        return seen

    def _play_worlds(self, actions: NDArray[Any], waiting: NDArray[np.bool_]) -> Step:
        going = ~waiting
        given, beyond = self.__clipped_to_space(actions)
        failed: dict[int, SimulationError] = {}
        until = self.simulation.times
        self.__waiting = waiting.copy()
        for _ in range(self.decimation):
            self.act(given.copy())
            until = until + self.interval / self.decimation
            failed |= self.__go_on(until, np.flatnonzero(~self.__waiting).tolist())
            self.__waiting[list(failed)] = True
        self.__steps[going] += 1
        self.__clipped[going] += beyond[going]
        is_failed = np.isin(np.arange(self.num_envs), list(failed))
        for world, error in failed.items():
            self.failures[world] = str(error)
        # A fault in a material that is written in Python is none of the episode's.
        to_raise = [error for error in failed.values() if not self.__ends or error.__cause__ is not None]
        if to_raise:
            raise to_raise[0]
        observations = self.__observed(list(range(self.num_envs)))
        rewards = self.__rows(self.reward(given), "reward", "fiu").astype(np.float64)
        rewards[is_failed] = 0.0
        wrong = np.flatnonzero(going & ~np.isfinite(rewards))
        if wrong.size:
            raise ValueError(f"reward: world {wrong[0]}'s is {rewards[wrong[0]]}; give a finite number")
        terminated = self.__rows(self.terminated(), "terminated", "b") | is_failed
        info = self.info()
        if not isinstance(info, dict) or not all(isinstance(name, str) and name[:1] != "_" and name not in _TOLD for name in info):
            raise ValueError(f"info: give a dict of arrays by names that begin with no underscore and are none of {', '.join(_TOLD)}")
        told = {name: self.__rows(values, f"info: {name}", "fiub") for name, values in info.items()}
        told["clipped"] = self.__clipped.copy()
        if self.__ends:
            told["failed"] = is_failed
        return observations, rewards, terminated, np.zeros(self.num_envs, np.bool_), told

    def __go_on(self, until: NDArray[np.float64], worlds: list[int]) -> dict[int, SimulationError]:
        """Worlds go on to a time of their own, those that start together, together. Returns what those say that cannot."""
        try:
            self.simulation.advance(self.interval / self.decimation, worlds=worlds)
        except SimulationError as error:
            first = error
        else:
            return {}
        failed = {}
        # Of several that cannot go on one has been raised: the others are asked again.
        for world in worlds:
            left = until[world] - self.simulation.times[world]
            if left <= _ROUNDING * self.interval:
                continue
            if first.world in (None, world):
                failed[world] = first
                continue
            try:
                self.simulation.advance(left, worlds=[world])
            except SimulationError as error:
                failed[world] = error
        if not failed:
            raise first
        return failed

    def _worlds_taken(self) -> NDArray[np.int64]:
        return self.__steps

    def _world_seed(self, before: int, random: np.random.Generator) -> int:
        differs = self.__is_random or _is_own(self.draw, SceneVectorEnv.draw)
        return int(random.integers(2**31)) if differs or before < 0 else before

    def _has_worlds(self) -> bool:
        return self.__simulation is not None

    def _check_reset_options(self, options: dict[str, Any]) -> None:
        """All are the subclass's."""

    def _world_picture(self, world: int) -> NDArray[np.uint8]:
        if world not in self.__views:
            self.__views[world] = View(self.simulation, world=world)
        return self.__views[world].draw(self.simulation, part=self.__part, world=world)

    def __drawn_scene(self, world: int) -> dict[str, Any]:
        drawn = self.draw(self.__generators[world], world)
        if not isinstance(drawn, dict):
            raise TypeError(f"draw: it returns {drawn!r}; return a dict of overrides")
        # A key that is left out would keep what the episode before has set.
        if self.__keys is not None and self.__keys != drawn.keys():
            raise ValueError(f"draw: it gave {sorted(self.__keys)} before and gives {sorted(drawn)} now; give the same keys each time")
        self.__keys = frozenset(drawn)
        return drawn

    def __checked(self, actions: Any) -> NDArray[Any]:
        """Actions of the right shape, as numbers that the space may hold; a `Box` may be left."""
        space = self.single_action_space
        if isinstance(space, spaces.Box):
            return checked_actions(actions, (self.num_envs, *space.shape), None, space.low, space.high)
        given = as_array(actions)
        whole = given.astype(self.action_space.dtype) if given.dtype.kind in "iu" else None
        if whole is None or not (np.array_equal(whole, given) and self.action_space.contains(whole)):
            raise BodyError(f"action: {given!r} (dtype {given.dtype}) is none of {self.action_space}; give whole numbers of that shape, within its limits")
        return whole

    def __clipped_to_space(self, actions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Actions within their space, and how many numbers of each world's were beyond."""
        space = self.single_action_space
        if not isinstance(space, spaces.Box):
            return actions, np.zeros(self.num_envs, np.int64)
        beyond = (actions < space.low) | (actions > space.high)
        return np.clip(actions, space.low, space.high), beyond.reshape(self.num_envs, -1).sum(axis=1)

    def __observed(self, worlds: list[int]) -> Seen:
        space, given = self.single_observation_space, self.observe(worlds)
        if isinstance(space, spaces.Box):
            return self.__as_in(space, given, "observe", worlds)
        if not isinstance(given, dict) or given.keys() != space.spaces.keys():
            what = f"a dict of {sorted(given, key=str)}" if isinstance(given, dict) else f"a {type(given).__name__}"
            raise ValueError(f"observe: it returns {what}; return a dict of arrays by the names {sorted(space.spaces)}")
        return {name: self.__as_in(part, given[name], f"observe: {name}", worlds) for name, part in space.spaces.items()}

    def __as_in(self, space: spaces.Box, given: Any, name: str, worlds: list[int]) -> NDArray[Any]:
        """What is seen of some worlds, as a space holds it."""
        seen = self.__numbers(given, name, "fiub" if space.dtype.kind == "f" else "iub")
        if seen.shape != (len(worlds), *space.shape):
            raise ValueError(f"{name}: it returns an array of shape {seen.shape} for worlds {worlds}; return one of {(len(worlds), *space.shape)}, a row for each")
        wrong = np.flatnonzero(np.isnan(seen.reshape(len(worlds), -1)).any(axis=1))
        if wrong.size:
            raise ValueError(f"{name}: the row of world {worlds[wrong[0]]} holds NaN: {seen[wrong[0]]}; give numbers")
        kept = seen.astype(space.dtype)
        if space.dtype.kind != "f" and not np.array_equal(kept, seen):
            raise ValueError(f"{name}: there are numbers from {seen.min()} to {seen.max()}, and {space.dtype} holds no such ones")
        return kept

    def __rows(self, values: Any, name: str, kinds: str) -> NDArray[Any]:
        rows = self.__numbers(values, name, kinds)
        if rows.shape != (self.num_envs,):
            raise ValueError(f"{name}: it is an array of shape {rows.shape}; return one of ({self.num_envs},), a number for each world")
        return rows

    def __numbers(self, values: Any, name: str, kinds: str) -> NDArray[Any]:
        try:
            given = as_array(values)
        except ValueError as error:
            raise ValueError(f"{name}: it is no array: {error}") from error
        if given.dtype.kind not in kinds:
            wanted = "bools" if kinds == "b" else "whole numbers" if "f" not in kinds else "numbers"
            raise TypeError(f"{name}: its dtype is {given.dtype}; return {wanted}")
        return given


class OneWorldEnv(gymnasium.Env):
    """The only world of a vector as an environment of its own, for what takes no vectors: `OneWorldEnv(MyTask(1, autoreset_mode="Disabled"))`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, vector: WorldsVectorEnv) -> None:
        if vector.num_envs != 1 or vector.autoreset_mode is not AutoresetMode.DISABLED:
            what = f"it has num_envs={vector.num_envs} and autoreset_mode={vector.autoreset_mode.value!r}"
            raise ValueError(f"vector: {what}; give one with num_envs=1 and autoreset_mode='Disabled'")
        self.vector = vector
        self.action_space = vector.single_action_space
        self.observation_space = vector.single_observation_space
        self.render_mode = vector.render_mode
        self.metadata = self.metadata | {"render_fps": vector.metadata["render_fps"]}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        [seed] = checked_seeds([seed])
        super().reset(seed=seed)
        observations, info = self.vector.reset(seed=seed, options=options)
        return row_of(observations, 0), _of_one(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observations, rewards, terminated, truncated, info = self.vector.step(action[None] if hasattr(action, "shape") else np.asarray(action)[None])
        return row_of(observations, 0), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), _of_one(info)

    def render(self) -> NDArray[np.uint8] | None:
        pictures = self.vector.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        self.vector.close()


def _of_one(info: dict[str, Any]) -> dict[str, Any]:
    return {name: values[0].item() for name, values in info.items() if not name.startswith("_")}


def _is_own(method: Any, plain: Any) -> bool:
    """Does a task have a method of its own?"""
    return getattr(method, "__func__", None) is not plain
