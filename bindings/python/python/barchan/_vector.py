"""Episodes in worlds of one simulation, whatever is done in them: their seeds, their ends, and how they begin anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from barchan._core import registry
from barchan.errors import BodyError

try:
    import gymnasium
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("gymnasium 1.1 or newer is missing: pip install 'barchan[gym]'") from error

# What is seen: an array with a row for each world, or such arrays by the names of a `Dict`.
Seen: TypeAlias = NDArray[Any] | dict[str, NDArray[Any]]
# Observations, rewards, terminated, truncated, and numbers that are told by name: arrays with a row for each world.
Step: TypeAlias = tuple[Seen, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, NDArray[Any]]]


class WorldsVectorEnv(VectorEnv):
    """Worlds of one simulation as environments. Subclasses say how episodes begin and what a control step does.

    What it keeps for itself has names with two underscores, so that those of a user's subclass are no others.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int,
        action_space: gymnasium.Space[Any],
        observation_space: gymnasium.Space[Any],
        max_episode_steps: int,
        render_mode: str | None,
        autoreset_mode: AutoresetMode | str,
        torch: bool | str,
    ) -> None:
        check_render_mode(render_mode, self.metadata["render_modes"])
        check_count("num_envs", num_envs)
        check_count("max_episode_steps", max_episode_steps)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_action_space = action_space
        self.single_observation_space = observation_space
        self.action_space = batch_space(action_space, num_envs)
        self.observation_space = batch_space(observation_space, num_envs)
        self.max_episode_steps = max_episode_steps
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        self.__torch = torch_device(torch)
        one = observation_space.spaces if isinstance(observation_space, gymnasium.spaces.Dict) else observation_space
        self.__seen: Seen = each_part(lambda space: np.zeros((num_envs, *space.shape), space.dtype), one)
        # Steps after which the episode in each world is truncated.
        self.__most = np.full(num_envs, max_episode_steps, np.int64)
        self.__seeds = np.full(num_envs, -1, np.int64)
        self.__random: list[np.random.Generator | None] = [None] * num_envs
        self.__drawn_from = [-1] * num_envs
        self.__ended = np.zeros(num_envs, np.bool_)
        self.__terminated = np.zeros(num_envs, np.bool_)

    def _begin_worlds(self, worlds: list[int], seeds: list[int], options: dict[str, Any]) -> Seen:
        """New episodes in these worlds, for which `reset` has been given these options. Returns what is seen of them, or of all worlds."""
        raise NotImplementedError

    def _play_worlds(self, actions: Any, waiting: NDArray[np.bool_]) -> Step:
        """A control step of all worlds but those that wait."""
        raise NotImplementedError

    def _worlds_taken(self) -> NDArray[np.integer[Any]]:
        """Control steps that each world's episode has taken."""
        raise NotImplementedError

    def _world_seed(self, before: int, random: np.random.Generator) -> int:
        """Seed of an episode for which none is given."""
        raise NotImplementedError

    def _has_worlds(self) -> bool:
        """Are there worlds?"""
        raise NotImplementedError

    def _check_reset_options(self, options: dict[str, Any]) -> None:
        """Refuses options of `reset` that mean nothing."""
        refuse_options(options, "known are 'reset_mask' and 'stagger'")

    def _world_picture(self, world: int) -> NDArray[np.uint8]:
        raise NotImplementedError

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins new episodes: world w with seed + w, or with the seed of a list; in all worlds, or in those of `options["reset_mask"]`, an array of bool.

        `options["stagger"] = True` truncates these episodes early, each world's at another time, so that worlds are at different times of their episodes from then on: what is
        seen of all of them in a few steps is then like what is seen in an episode.
        """
        if isinstance(seed, (Sequence, np.ndarray)):
            seeds = list(seed)
        else:
            [first] = checked_seeds([seed])
            seeds = [None if first is None else first + w for w in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: there are {len(seeds)} of them for {self.num_envs} worlds")
        seeds = checked_seeds(seeds)
        check_options(options)
        mask = (options or {}).get("reset_mask")
        own = {name: value for name, value in (options or {}).items() if name not in ("reset_mask", "stagger")}
        self._check_reset_options(own)
        chosen = np.ones(self.num_envs, np.bool_) if mask is None else np.asarray(mask)
        if chosen.shape != (self.num_envs,) or chosen.dtype != np.bool_ or not chosen.any():
            raise ValueError(f"reset_mask: give an array of {self.num_envs} bools, one of them True at least")
        if not (chosen.all() or self._has_worlds()):
            # Worlds must be there before some of them can begin anew.
            raise reset_needed()
        for world in np.flatnonzero(chosen).tolist():
            given = seeds[world]
            if given is not None or self.__random[world] is None:
                self.__random[world], self.__drawn_from[world] = seeding.np_random(given)
            self.__seeds[world] = given if given is not None else self.__drawn(world)
        self.__ended[chosen] = False
        self.__again(chosen, own)
        if (options or {}).get("stagger"):
            count = int(chosen.sum())
            self.__most[chosen] = np.maximum(self.max_episode_steps * np.arange(1, count + 1) // count, 1)
        return self.__out(each_part(np.copy, self.__seen)), self.__seed_info(chosen)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        if not self._has_worlds():
            raise reset_needed()
        anew = self.__ended.copy()
        # Worlds whose episode has ended wait.
        self.__seen, rewards, terminated, truncated, told = self._play_worlds(actions, anew)
        truncated |= self._worlds_taken() >= self.__most
        info: dict[str, Any] = {}
        present = ~anew
        for name, values in told.items():
            info[name], info[f"_{name}"] = values, present.copy()
        if anew.any():
            rewards[anew] = 0.0
            if "success" in told:
                told["success"][anew] = False
            if self.autoreset_mode is AutoresetMode.DISABLED:
                terminated[anew], truncated[anew] = self.__terminated[anew], ~self.__terminated[anew]
            else:
                self.__draw(anew)
                self.__again(anew, {})
                terminated[anew], truncated[anew] = False, False
                info |= self.__seed_info(anew)
        ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            last = np.full(self.num_envs, None, dtype=object)
            for world in np.flatnonzero(ended):
                last[world] = self.__out(each_part(lambda row: row.copy(), row_of(self.__seen, world)))
            final = {name: ended.copy() if name.startswith("_") else values.copy() for name, values in info.items()}
            info = {name: values & ~ended if name.startswith("_") else values for name, values in info.items()}
            info |= {"final_obs": last, "_final_obs": ended.copy(), "final_info": final, "_final_info": ended.copy()}
            self.__draw(ended)
            self.__again(ended, {})
            info |= self.__seed_info(ended)
            self.__ended[:] = False
        else:
            self.__ended, self.__terminated = ended, terminated.copy()
        return self.__out(each_part(np.copy, self.__seen)), self.__out(rewards), self.__out(terminated), self.__out(truncated), info

    @property
    def np_random_seed(self) -> tuple[int, ...]:
        """The seed of each world's generator of seeds, -1 before the first reset, as `SyncVectorEnv` tells it."""
        return tuple(self.__drawn_from)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """Each world's generator of seeds, after the first reset."""
        return tuple(random for random in self.__random if random is not None)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of each world."""
        if self.render_mode is None:
            return None
        return tuple(self._world_picture(world) for world in range(self.num_envs))

    def __drawn(self, world: int) -> int:
        random = self.__random[world]
        assert random is not None
        return self._world_seed(int(self.__seeds[world]), random)

    def __draw(self, chosen: NDArray[np.bool_]) -> None:
        for world in np.flatnonzero(chosen).tolist():
            self.__seeds[world] = self.__drawn(world)

    def __again(self, chosen: NDArray[np.bool_], options: dict[str, Any]) -> None:
        """Begins new episodes in some worlds."""
        worlds = np.flatnonzero(chosen).tolist()
        self.__most[worlds] = self.max_episode_steps
        self.closed = False
        seen = self._begin_worlds(worlds, self.__seeds[worlds].tolist(), options)
        self.__seen = each_part(lambda before, new: with_rows(before, worlds, new), self.__seen, seen)

    def __seed_info(self, chosen: NDArray[np.bool_]) -> dict[str, Any]:
        return {"seed": np.where(chosen, self.__seeds, 0), "_seed": chosen.copy()}

    def __out(self, array: Any) -> Any:
        """An array as the user wants it, or arrays by name."""
        device = self.__torch
        return array if device is None else each_part(lambda part: as_tensor(part, device), array)

    def __getstate__(self) -> dict[str, Any]:
        refuse_pickle(self._has_worlds())
        return self.__dict__


def each_part(change: Callable[..., Any], seen: Any, *others: Any) -> Any:
    """Changes what is seen, or each of its parts by name, given those of others that have the same names."""
    if not isinstance(seen, dict):
        return change(seen, *others)
    return {name: change(part, *(other[name] for other in others)) for name, part in seen.items()}


def row_of(seen: Any, world: int) -> Any:
    """What is seen of one world."""
    return each_part(lambda part: part[world], seen)


def with_rows(all_rows: Any, worlds: list[int], rows: Any) -> Any:
    """Rows of all worlds, of which some are new; or all of them are."""
    if len(rows) == len(all_rows):
        return rows
    all_rows[worlds] = rows
    return all_rows


def check_render_mode(mode: str | None, known: list[str]) -> None:
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode: {mode!r} is none of {', '.join(map(repr, known))}, None")


def check_count(name: str, count: Any) -> None:
    if not (isinstance(count, (int, np.integer)) and count >= 1):
        raise ValueError(f"{name}: {count!r} is none; give a whole number from 1 on")


def check_machine(backend: Any, precision: Any, threads: Any) -> None:
    """What worlds run on, before there are any."""
    known = registry()["backends"]
    if backend not in known:
        raise ValueError(f"backend: {backend!r} is none; there are {', '.join(map(repr, known))}")
    if precision not in ("f32", "f64"):
        raise ValueError(f"precision: {precision!r} is neither 'f32' nor 'f64'")
    if not (isinstance(threads, (int, np.integer)) and threads >= 0):
        raise ValueError(f"threads: {threads!r} is no number of them; give a whole number, 0 for as many as the machine has")


def check_options(options: Any) -> None:
    if not (options is None or isinstance(options, dict)):
        raise TypeError(f"options: {options!r} is no dict of them")


def refuse_options(options: dict[str, Any] | None, mend: str) -> None:
    check_options(options)
    if options:
        raise ValueError(f"options: {', '.join(map(repr, options))} mean nothing here; {mend}")


def checked_seeds(seeds: list[Any]) -> list[int | None]:
    for seed in seeds:
        is_whole = isinstance(seed, (int, np.integer)) and not isinstance(seed, bool)
        if seed is not None and not (is_whole and 0 <= seed < 2**63):
            raise ValueError(f"seed: {seed!r} is none; give whole numbers from 0 to 2^63 - 1")
    # Gymnasium takes no whole numbers of NumPy's.
    return [None if seed is None else int(seed) for seed in seeds]


def checked_actions(
    actions: Any, shape: tuple[int, ...], names: Sequence[str] | None, low: NDArray[Any], high: NDArray[Any]
) -> NDArray[np.float64]:
    """Actions as finite numbers of a shape. Each number is called by its name, or by its place without names; `low` and `high` are its limits in one world."""
    given = as_array(actions)
    if given.dtype.kind not in "fiu":
        raise TypeError(f"action: its dtype is {given.dtype}; give numbers, float32 for example")
    if given.shape != shape:
        raise BodyError(f"action: its shape is {given.shape}; give {shape}{'' if names is None else ': ' + ', '.join(names)}")
    given = given.astype(np.float64)
    if not np.isfinite(given).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(given))[0])
        own = place[given.ndim - low.ndim :]
        where = "" if own == place else f"world {place[0]}: "
        name = names[own[0]] if names is not None else f"number {', '.join(map(str, own))}" if own else "the number"
        raise BodyError(f"action: {where}{name} is {given[place]}; give a number from {low[own]:g} to {high[own]:g}")
    return given


def as_array(values: Any) -> NDArray[Any]:
    """A copy of numbers, or of a tensor's, as an array."""
    return np.array(values.detach().cpu().numpy() if hasattr(values, "detach") else values)


def torch_device(torch: bool | str) -> str | None:
    return None if torch is False else "cpu" if torch is True else torch


def as_tensor(array: Any, device: str) -> Any:
    try:
        import torch
    except ImportError as error:
        raise gymnasium.error.DependencyNotInstalled("torch is missing: pip install torch, or leave torch=True out") from error
    return torch.as_tensor(np.ascontiguousarray(array), device=device)


def reset_needed() -> Exception:
    return gymnasium.error.ResetNeeded("call reset() first: there is no episode yet")


def refuse_pickle(has_begun: bool) -> None:
    if has_begun:
        raise TypeError(
            "an environment that has begun cannot be pickled or copied; do so before its first reset(), or make one in the process that needs it"
        )
