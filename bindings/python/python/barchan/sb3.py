"""Worlds of one simulation for Stable-Baselines3 (`pip install 'barchan[learn]'`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from barchan._vector import Seen, WorldsVectorEnv

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError("stable-baselines3 is missing: pip install 'barchan[learn]'") from error

__all__ = ["Worlds"]


class Worlds(VecEnv):
    """What Stable-Baselines3 calls a VecEnv, of a `TaskVectorEnv` or `SceneVectorEnv` with autoreset_mode="SameStep".

    Stable-Baselines3's own would make a simulation for each environment; here all are worlds of one. `set_options({"stagger": True})` before a reset lets episodes begin at
    different times (`TaskVectorEnv.reset`).
    """

    def __init__(self, vector: WorldsVectorEnv) -> None:
        if vector.autoreset_mode.value != "SameStep":
            raise ValueError(f"autoreset_mode: it is {vector.autoreset_mode.value!r}; Stable-Baselines3 needs 'SameStep'")
        self.vector = vector
        self._actions: NDArray[np.float32] | None = None
        super().__init__(vector.num_envs, vector.single_observation_space, vector.single_action_space)

    def reset(self) -> Seen:
        given = [seed for seed in self._seeds if seed is not None]
        # Options of environments are those of the first: worlds begin together.
        observations, _ = self.vector.reset(seed=list(self._seeds) if given else None, options=self._options[0])
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Seen, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, info = self.vector.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(ended):
            final = info["final_info"]
            infos[world] = {name: values[world].item() for name, values in final.items() if not name.startswith("_")}
            infos[world] |= {"terminal_observation": info["final_obs"][world], "TimeLimit.truncated": bool(truncated[world] and not terminated[world])}
        return observations, rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        self.vector.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        return self.vector.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.vector, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f"{attr_name}: worlds of one simulation have no attributes of their own")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise AttributeError(f"{method_name}: worlds of one simulation have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
