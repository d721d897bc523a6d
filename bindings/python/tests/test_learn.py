"""The extra `learn`: `bash bindings/python/test.sh --learn` installs what it takes and runs these tests. They are left out without it."""

import json
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import barchan

pytestmark = pytest.mark.learn

LITE = [name for name in barchan.registry()["tasks"] if name.endswith("-lite")]
TASK = "SmoothSurface-lite"


@pytest.mark.parametrize("name", LITE)
def test_stable_baselines_checker_finds_nothing(name):
    from stable_baselines3.common.env_checker import check_env

    from barchan.envs import TaskEnv

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(TaskEnv(name, render_mode="rgb_array"))


def test_stable_baselines_learns_in_worlds_of_one_simulation():
    from stable_baselines3 import PPO

    from barchan.envs import TaskVectorEnv
    from barchan.sb3 import Worlds

    with pytest.raises(ValueError, match="SameStep"):
        Worlds(TaskVectorEnv(TASK, 2))
    worlds = Worlds(TaskVectorEnv(TASK, 3, autoreset_mode="SameStep", max_episode_steps=5))
    worlds.seed(4)
    first = worlds.reset()
    assert first.shape == (3, barchan.task(TASK).observation_size) and worlds.vector.worlds.seeds.tolist() == [4, 5, 6]
    for step in range(5):
        seen, rewards, ended, infos = worlds.step(np.zeros((3, 4), np.float32))
    assert ended.all() and rewards.dtype == np.float32
    np.testing.assert_array_equal(seen, first)
    assert all(info["TimeLimit.truncated"] and np.any(info["terminal_observation"] != seen[0]) for info in infos)
    PPO("MlpPolicy", worlds, n_steps=8, batch_size=12, device="cpu").learn(24)


def test_stable_baselines_learns_a_task_of_ones_own():
    import gymnasium
    from stable_baselines3 import PPO

    from barchan.envs import SceneVectorEnv
    from barchan.sb3 import Worlds

    class Press(SceneVectorEnv):
        def act(self, actions):
            self.simulation.act("ball", linear=np.pad(actions, ((0, 0), (2, 0))))

        def observe(self, worlds):
            return self.simulation.body_arrays("ball", worlds=worlds).position[:, 2:]

        def reward(self, actions):
            return -actions[:, 0]

    box = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    scene = {
        "name": "press",
        "world": {"cell": 0.1, "min": [0, 0, 0], "max": [0.8, 0.8, 0.8]},
        "time": {"end": 1.0},
        "material": [{"name": "snow", "law": "snow", "density": 400.0}],
        "body": [{"material": "snow", "shape": {"box": {"min": [0.2, 0.2, 0], "max": [0.6, 0.6, 0.4]}}}],
        "tool": [{"name": "ball", "shape": {"sphere": {"radius": 0.1}}, "position": [0.4, 0.4, 0.6], "motion": {"velocity": {}}}],
    }
    options = {"interval": 0.005, "max_episode_steps": 4, "action_space": box, "observation_space": box}
    worlds = Worlds(Press(scene, 3, autoreset_mode="SameStep", **options))
    worlds.reset()
    for _ in range(4):
        _, _, ended, infos = worlds.step(np.zeros((3, 1), np.float32))
    assert ended.all() and all(info["TimeLimit.truncated"] for info in infos)
    PPO("MlpPolicy", worlds, n_steps=8, batch_size=12, device="cpu").learn(24)

    class Parts(Press):
        def observe(self, worlds):
            ball = self.simulation.body_arrays("ball", worlds=worlds)
            return {"height": ball.position[:, 2:], "velocity": ball.velocity}

    options["observation_space"] = gymnasium.spaces.Dict({"height": box, "velocity": gymnasium.spaces.Box(-1.0, 1.0, (3,))})
    worlds = Worlds(Parts(scene, 3, autoreset_mode="SameStep", **options))
    first = worlds.reset()
    for _ in range(4):
        seen, _, ended, infos = worlds.step(np.ones((3, 1), np.float32))
    assert ended.all() and np.array_equal(seen["height"], first["height"])
    assert all(info["terminal_observation"]["height"] > first["height"][0] for info in infos)
    PPO("MultiInputPolicy", worlds, n_steps=8, batch_size=12, device="cpu").learn(24)
    tensors, _ = Parts(scene, 2, torch=True, **options).reset(seed=0)
    assert tensors["velocity"].shape == (2, 3) and np.array_equal(tensors["height"].numpy(), first["height"][:2])


def test_tensors_go_in_and_come_out():
    import torch

    from barchan.envs import TaskEnv, TaskVectorEnv

    plain, tensors = TaskVectorEnv(TASK, 2), TaskVectorEnv(TASK, 2, torch=True)
    expected, _ = plain.reset(seed=1)
    seen, _ = tensors.reset(seed=1)
    assert isinstance(seen, torch.Tensor) and seen.dtype == torch.float32
    np.testing.assert_array_equal(seen.numpy(), expected)
    actions = torch.full((2, 4), 0.5, requires_grad=True)
    step, expected = tensors.step(actions), plain.step(np.full((2, 4), 0.5))
    for ours, theirs in zip(step[:4], expected[:4]):
        np.testing.assert_array_equal(ours.numpy(), theirs)
    single = TaskEnv(TASK, torch="cpu")
    single.reset(seed=1)
    seen, reward, *_ = single.step(actions[0])
    np.testing.assert_array_equal(seen.numpy(), expected[0][0])
    assert reward == expected[1][0]


@pytest.mark.parametrize("agent", ["ppo", "sac"])
def test_policies_are_learned_from_the_command_line(agent, tmp_path):
    command = [sys.executable, "-m", "barchan.bench", "learn", "--agent", agent, "--budget", "600", "--worlds", "4", "--steps", "10"]
    done = subprocess.run([*command, "--device", "cpu", "--out", tmp_path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["agent"] == agent and np.isfinite(summary["policy"]["return"]) and summary["environment_steps"] >= 600
    assert len(json.loads((tmp_path / "best.json").read_text())["actions"]) == 10
    assert (tmp_path / "curve.png").stat().st_size > 1000 and (tmp_path / "policy.zip").exists()
    assert list((tmp_path / "tensorboard").rglob("events.out.tfevents.*"))


def test_the_example_of_a_network_in_the_documentation_learns():
    text = (Path(__file__).resolve().parents[3] / "docs" / "gradients.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    [network] = [block for block in blocks if "torch" in block]
    [pushed] = [block for block in blocks if "def push(" in block]
    code = pushed + network + """
with torch.no_grad():
    ahead, behind = (Push.apply(speeds.detach() + by * torch.tensor([0.0, 1e-4, 0.0]))[:, 0].mean() for by in (1.0, -1.0))
speeds = speeds.detach().requires_grad_()
Push.apply(speeds)[:, 0].mean().backward()
slope = ((ahead - behind) / 2e-4).item()
assert abs(speeds.grad[1].item() - slope) < 1e-4 * abs(slope), (speeds.grad, slope)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
