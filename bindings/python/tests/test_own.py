"""Tasks of one's own: what a subclass says is done in every world, and episodes end and begin as Gymnasium has it."""

import pickle
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import barchan
from barchan.envs import OneWorldEnv, SceneVectorEnv

ROOT = Path(__file__).parents[3]
INTERVAL = 0.004


def scene(**world):
    """A plate above a block of snow."""
    return {
        "name": "press",
        "world": {"cell": 0.05, "min": [0, 0, 0], "max": [0.4, 0.4, 0.4], "walls": {"z_min": "stick"}} | world,
        "time": {"end": 0.2},
        "material": [{"name": "snow", "law": "snow", "density": 400.0}],
        "body": [{"material": "snow", "shape": {"box": {"min": [0.1, 0.1, 0], "max": [0.3, 0.3, 0.2]}}}],
        "tool": [
            {"name": "plate", "shape": {"box": {"half": [0.1, 0.1, 0.02]}}, "position": [0.2, 0.2, 0.23], "motion": {"velocity": {}}},
        ],
    }


class Press(SceneVectorEnv):
    """The plate is to press."""

    asked: list[str]

    def __init__(self, num_envs=1, given=None, **options):
        self.asked = []
        super().__init__(
            given or scene(),
            num_envs,
            interval=INTERVAL,
            max_episode_steps=5,
            action_space=gymnasium.spaces.Box(-1.0, 1.0, (1,)),
            observation_space=gymnasium.spaces.Box(-1e6, 1e6, (2,)),
            **options,
        )

    def act(self, actions):
        self.asked.append("act")
        self.simulation.act("plate", linear=np.concatenate([np.zeros((self.num_envs, 2)), 2.0 * actions], axis=1))

    def observe(self, worlds):
        self.asked.append("observe")
        self.plate = self.simulation.body_arrays("plate", worlds=worlds)
        return np.stack([self.plate.position[:, 2], self.plate.force[:, 2]], axis=1)

    def reward(self, actions):
        self.asked.append("reward")
        return self.plate.force[:, 2] - actions[:, 0]

    def terminated(self):
        self.asked.append("terminated")
        return self.plate.position[:, 2] < 0.211

    def info(self):
        self.asked.append("info")
        return {"height": self.plate.position[:, 2]}


class Drawn(Press):
    """The same on snow that differs."""

    def draw(self, random, world):
        return {"material.snow.parameters.young_modulus": random.uniform(1e5, 2e5)}


def seen(vector, actions, seed=0):
    """Observations and rewards of control steps behind a reset."""
    first, _ = vector.reset(seed=seed)
    steps = [vector.step(np.full((vector.num_envs, 1), action, np.float32))[:2] for action in actions]
    return np.array([first] + [step[0] for step in steps]), np.array([step[1] for step in steps])


def test_a_control_step_is_what_a_simulation_does_by_hand():
    observed, rewards = seen(Press(2), [-1.0, -1.0, 0.5])
    # Worlds begin alike.
    by_hand = barchan.Simulation(scene(), worlds=2, seed=[0, 0])
    for step, action in enumerate([-1.0, -1.0, 0.5], 1):
        by_hand.act("plate", linear=[0.0, 0.0, 2.0 * action])
        by_hand.advance(INTERVAL)
        plate = by_hand.body_arrays("plate")
        assert np.array_equal(observed[step], np.stack([plate.position[:, 2], plate.force[:, 2]], axis=1).astype(np.float32))
        assert np.array_equal(rewards[step - 1], plate.force[:, 2] - action)
    assert rewards[1].min() > 10.0, "the plate presses the snow"
    own = Press(2)
    again = [seen(own, [-1.0, -1.0, 0.5]) for _ in range(2)][1]
    assert np.array_equal(again[0], observed) and np.array_equal(again[1], rewards)
    own.asked.clear()
    own.step([[2.0], [0.0]])
    assert own.asked == ["act", "observe", "reward", "terminated", "info"]


def test_what_is_beyond_the_space_is_cut_off_and_counted():
    vector = Press(2)
    vector.reset(seed=0)
    _, rewards, *_, info = vector.step(np.array([[-3.0], [-1.0]]))
    assert rewards[0] == rewards[1] and info["clipped"].tolist() == [1, 0]
    with pytest.raises(barchan.BodyError, match=r"world 1: number 0 is nan; give a number from -1 to 1"):
        vector.step(np.array([[0.0], [np.nan]]))
    with pytest.raises(barchan.BodyError, match=r"its shape is \(1, 1\); give \(2, 1\)"):
        vector.step(np.zeros((1, 1)))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_episodes_end_and_begin_as_gymnasium_has_it(mode):
    vector = Press(2, autoreset_mode=mode)
    first, _ = vector.reset(seed=3)
    press = np.array([[-1.0], [0.0]])
    steps = 0
    terminated = np.zeros(2, np.bool_)
    while not terminated.any():
        last, _, terminated, truncated, info = vector.step(press)
        steps += 1
    assert steps == 3 and terminated.tolist() == [True, False] and not truncated.any()
    if mode == "SameStep":
        assert np.array_equal(last[0], first[0]) and info["final_obs"][0][0] < 0.211 and info["final_info"]["height"][0] < 0.211
        assert vector.steps_taken.tolist() == [0, 3]
        return
    assert last[0][0] < 0.211
    following, rewards, terminated, truncated, info = vector.step(press)
    assert rewards[0] == 0.0
    if mode == "NextStep":
        assert np.array_equal(following[0], first[0]) and not terminated[0]
        assert vector.steps_taken.tolist() == [0, 4] and vector.simulation.times[0] == 0.0
    else:
        assert np.array_equal(following[0], last[0]) and terminated[0] and vector.steps_taken.tolist() == [3, 4]
        again, _ = vector.reset(options={"reset_mask": np.array([True, False])})
        assert np.array_equal(again[0], first[0]) and np.array_equal(again[1], following[1])
    *_, truncated, _ = vector.step(0.0 * press)
    assert truncated.tolist() == [False, True], "five steps are the most"


def test_seeds_draw_scenes_and_the_same_ones_the_same():
    press = [-1.0, -1.0]
    vector = Drawn(3)
    observed, _ = seen(vector, press, seed=[1, 2, 1])
    assert observed[-1][0][1] != observed[-1][1][1]
    again, _ = seen(vector, press, seed=[1, 2, 1])
    assert np.array_equal(observed, again)
    other = Drawn(3)
    assert np.array_equal(seen(other, press, seed=[1, 2, 1])[0], observed)
    # Without a seed new ones are drawn, since they change something.
    _, info = vector.reset()
    assert len(set(info["seed"].tolist()) | {1, 2}) == 4, "the first and the last world draw alike"
    # What seeds do not change begins the same episode again.
    assert Press(1).reset(seed=4)[1]["seed"] == 4
    same = Press(1)
    same.reset(seed=4)
    assert same.reset()[1]["seed"] == 4

    class Fickle(Press):
        def draw(self, random, world):
            return {"time.end": 1.0} if random.random() < 0.5 else {}

    with pytest.raises(ValueError, match="draw: it gave .*; give the same keys each time"):
        Fickle(8).reset(seed=0)


class Rising(Press):
    """In some worlds snow flies out of the world, which allows none to."""

    def draw(self, random, world):
        return {"body[0].velocity": [0.0, 0.0, random.choice([0.0, 60.0])]}


@pytest.mark.parametrize("failures", ["raise", "end"])
def test_a_world_that_cannot_go_on_holds_no_other_up(failures):
    given = scene(leaving="error")
    given["tool"] = [{"name": "plate", "shape": {"sphere": {"radius": 0.02}}, "position": [0.05, 0.05, 0.3], "motion": {"velocity": {}}}]
    vector = Rising(4, given, failures=failures, autoreset_mode="Disabled")
    vector.reset(seed=[0, 1, 2, 3])
    flies = np.array([np.random.default_rng(seed).choice([0.0, 60.0]) > 0.0 for seed in range(4)])
    assert 0 < flies.sum() < 4
    still = np.zeros((4, 1))
    if failures == "raise":
        with pytest.raises(barchan.SimulationError, match="left the world"):
            vector.step(still)
        assert np.allclose(vector.simulation.times[~flies], INTERVAL) and (vector.simulation.times[flies] < INTERVAL).all()
        return
    _, rewards, terminated, _, info = vector.step(still)
    assert np.array_equal(terminated, flies) and np.array_equal(info["failed"], flies) and not rewards[flies].any()
    assert [why is not None and "left the world" in why for why in vector.failures] == flies.tolist()
    *_, terminated, _, info = vector.step(still)
    assert np.array_equal(terminated, flies) and not info["_failed"][flies].any()
    assert np.allclose(vector.simulation.times[~flies], 2 * INTERVAL)


def test_one_world_passes_gymnasiums_checker_and_registers():
    gymnasium.register("Press-v0", entry_point=lambda **o: OneWorldEnv(Press(1, autoreset_mode="Disabled", **o)), vector_entry_point=Press)
    one = gymnasium.make("Press-v0", render_mode="rgb_array").unwrapped
    check_env(one)
    one.reset(seed=1)
    observation, reward, terminated, truncated, info = one.step(np.array([-1.0], np.float32))
    assert observation.shape == (2,) and isinstance(reward, float) and info["height"] == pytest.approx(0.222) and not (terminated or truncated)
    picture = one.render()
    assert picture.ndim == 3 and picture.std() > 1.0
    with pytest.raises(ValueError, match="num_envs=2.*give one with num_envs=1"):
        OneWorldEnv(Press(2))
    assert gymnasium.make_vec("Press-v0", num_envs=3).reset(seed=0)[0].shape == (3, 2)


class Noisy(Drawn):
    """What is seen has noise, and a difference to what was seen before."""

    def __init__(self, num_envs=1, **options):
        self.before = np.zeros((num_envs, 2))
        super().__init__(num_envs, **options)

    def begin(self, worlds):
        self.before[worlds] = 0.0

    def observe(self, worlds):
        seen = super().observe(worlds)
        seen += [self.random(world).normal(size=2) for world in worlds]
        change = seen - self.before[worlds]
        self.before[worlds] = seen
        return change

    def terminated(self):
        return np.array([self.random(world).random() < 0.3 for world in range(self.num_envs)])


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_worlds_are_what_they_are_alone_whenever_others_begin_anew(mode):
    vector = Noisy(3, autoreset_mode=mode)
    alone = [Noisy(1, autoreset_mode=mode) for _ in range(3)]
    observed = [vector.reset(seed=5)[0]] + [vector.step(np.full((3, 1), -0.5))[0] for _ in range(8)]
    for world, one in enumerate(alone):
        own = [one.reset(seed=5 + world)[0]] + [one.step([[-0.5]])[0] for _ in range(8)]
        assert np.array_equal(np.array(observed)[:, world], np.array(own)[:, 0])
    # Noise alone is reason enough for a new seed.
    assert len({Noisy(1).reset(seed=None)[1]["seed"][0] for _ in range(2)} | {vector.reset()[1]["seed"][0] for _ in range(2)}) == 4


def test_episodes_that_an_exception_has_broken_off_have_to_be_reset():
    class Breaking(Press):
        at = ""

        def begin(self, worlds):
            if self.at == "begin":
                raise RuntimeError(self.at)

        def reward(self, actions):
            if self.at == "reward":
                raise KeyboardInterrupt
            return super().reward(actions)

    vector = Breaking(3)
    first, _ = vector.reset(seed=0)
    still = np.zeros((3, 1))
    with pytest.raises(barchan.BodyError):
        vector.step(still + np.nan)
    vector.step(still)
    vector.at = "reward"
    with pytest.raises(KeyboardInterrupt):
        vector.step(still)
    vector.at = ""
    with pytest.raises(ValueError, match="worlds 0, 1, 2: a control step or a reset was interrupted half way; reset"):
        vector.step(still)
    vector.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(ValueError, match="worlds 1: "):
        vector.step(still)
    assert np.array_equal(vector.reset()[0], first)
    vector.at = "begin"
    with pytest.raises(RuntimeError):
        vector.reset(options={"reset_mask": np.array([False, False, True])})
    with pytest.raises(ValueError, match="worlds 2: "):
        vector.step(still)


def test_worlds_on_a_gpu_begin_anew_beside_others():
    # Steps that are chosen are as long in all worlds on a GPU.
    vector, truth = (Press(2, backend=on, autoreset_mode="Disabled", overrides={"time.step": 2.5e-4}) for on in ("wgpu", "cpu"))
    press = np.array([[-1.0], [-0.5]])
    mask = np.array([False, True])
    for one in (vector, truth):
        one.reset(seed=0)
        one.step(press)
        one.step(press)
        one.reset(options={"reset_mask": mask})
    assert vector.simulation.backend == "wgpu" and vector.steps_taken.tolist() == [2, 0]
    for _ in range(2):
        observed, rewards, *_ = vector.step(press)
        expected, wanted, *_ = truth.step(press)
        # Forces are of some hundred N.
        assert np.allclose(observed, expected, rtol=1e-3, atol=0.1) and np.allclose(rewards, wanted, rtol=1e-3, atol=0.1)
    # The plate of the first has come down.
    assert vector.steps_taken.tolist() == [3, 2] == truth.steps_taken.tolist()


def test_worlds_that_wait_are_named_to_act():
    class Lifting(Press):
        def act(self, actions):
            self.waited = self.waiting

    vector = Lifting(2, autoreset_mode="Disabled")
    vector.terminated = lambda: np.array([True, False])
    vector.reset(seed=0)
    vector.step(np.zeros((2, 1)))
    assert not vector.waited.any()
    vector.step(np.zeros((2, 1)))
    assert vector.waited.tolist() == [True, False]


def test_commands_within_a_step_options_and_whole_numbers():
    class Stepped(Press):
        def begin(self, worlds):
            self.given = self.options

        def act(self, actions):
            self.asked.append("act")
            self.simulation.act("plate", linear=[0.0, 0.0, -0.1 * len(self.asked)])

    vector = Stepped(1, decimation=3)
    vector.reset(seed=0, options={"level": 3})
    assert vector.given == {"level": 3}
    vector.asked.clear()
    observed, *_ = vector.step([[0.0]])
    assert vector.asked[:3] == ["act"] * 3
    assert observed[0, 0] == pytest.approx(0.23 - 0.1 * (1 + 2 + 3) * INTERVAL / 3, abs=1e-6)

    class Whole(SceneVectorEnv):
        def act(self, actions):
            self.simulation.act("plate", linear=[[0.0, 0.0, 0.1 * (a - 1)] for a in actions])
            actions[:] = 7

        def observe(self, worlds):
            return self.simulation.body_arrays("plate", worlds=worlds).velocity[:, 2:]

        def reward(self, actions):
            return actions

    box = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    whole = Whole(scene(), 3, interval=INTERVAL, max_episode_steps=9, action_space=gymnasium.spaces.Discrete(3), observation_space=box)
    whole.reset(seed=0)
    observed, rewards, *_ = whole.step(np.array([0, 1, 2]))
    assert np.allclose(observed[:, 0], [-0.1, 0.0, 0.1]) and rewards.tolist() == [0, 1, 2]
    for wrong in ([0, 1, 3], [0.0, 1.0, 2.0], [0, 1]):
        with pytest.raises(barchan.BodyError, match="give whole numbers"):
            whole.step(np.array(wrong))
    with pytest.raises(ValueError, match="'reset_masks' mean nothing here; known are 'reset_mask'"):
        barchan.envs.TaskVectorEnv("SmoothSurface-lite", 1).reset(options={"reset_masks": 1})


class Parts(SceneVectorEnv):
    """The plate, seen in parts by name."""

    def __init__(self, num_envs, **options):
        boxes = {"height": gymnasium.spaces.Box(-9.0, 9.0, (1,)), "ground": gymnasium.spaces.Box(-9.0, 9.0, (2, 2), np.float64)}
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
        space = gymnasium.spaces.Dict(boxes)
        super().__init__(scene(), num_envs, interval=INTERVAL, max_episode_steps=3, action_space=action_space, observation_space=space, **options)

    act = Press.act
    asked: list[str] = []

    def observe(self, worlds):
        self.plate = self.simulation.body_arrays("plate", worlds=worlds)
        ground = self.simulation.height_arrays([[0.2, 0.2], [0.05, 0.05], [0.2, 0.15], [0.15, 0.2]], worlds=worlds)
        return {"height": self.plate.position[:, 2:], "ground": ground.reshape(-1, 2, 2)}

    def reward(self, actions):
        return self.plate.force[:, 2]


def test_observations_may_have_parts_by_name():
    actions = np.array([[-1.0], [0.5]], np.float32)
    vector = Parts(2)
    first, _ = vector.reset(seed=0)
    assert vector.observation_space.contains(first) and first["height"].dtype == np.float32 and first["ground"].dtype == np.float64
    steps = [vector.step(actions) for _ in range(4)]
    assert steps[0][0]["height"][0] < first["height"][0] < steps[0][0]["height"][1]
    assert first["ground"].shape == (2, 2, 2) and first["ground"][0, 0, 1] == 0.0 < first["ground"][0, 0, 0]
    # The step behind the end begins the next episode.
    assert steps[2][3].all() and all(np.array_equal(steps[3][0][name], first[name]) for name in first)
    # What is told of an episode's end, and of worlds that begin anew alone.
    same = Parts(2, autoreset_mode="SameStep")
    same.reset(seed=0)
    last = [same.step(actions) for _ in range(3)][-1]
    for world, final in enumerate(last[4]["final_obs"]):
        assert all(np.array_equal(final[name], steps[2][0][name][world]) for name in final)
        assert all(np.array_equal(last[0][name], first[name]) for name in first)
    waits = Parts(2, autoreset_mode="Disabled")
    waits.reset(seed=0)
    moved = waits.step(actions)[0]
    again, _ = waits.reset(options={"reset_mask": np.array([False, True])})
    for name in first:
        assert np.array_equal(again[name][0], moved[name][0]) and np.array_equal(again[name][1], first[name][1])
    check_env(OneWorldEnv(Parts(1, autoreset_mode="Disabled")), skip_render_check=True)
    for wrong, said in [
        (lambda worlds: np.zeros((2, 1)), r"observe: it returns a ndarray; return a dict of arrays by the names \['ground', 'height'\]"),
        (lambda worlds: {"height": np.zeros((2, 1))}, r"observe: it returns a dict of \['height'\]"),
        (lambda worlds: {"height": np.zeros((2, 1)), "ground": np.zeros((2, 2))}, r"observe: ground: it returns an array of shape \(2, 2\)"),
    ]:
        faulty = Parts(2)
        faulty.observe = wrong
        with pytest.raises(ValueError, match=said):
            faulty.reset(seed=0)


def test_what_a_subclass_returns_is_held_to_its_shapes():
    class Flat(Press):
        def observe(self, worlds):
            return np.zeros(len(worlds))

    class Scalar(Press):
        def reward(self, actions):
            return 1.0

    with pytest.raises(ValueError, match=r"observe: it returns an array of shape \(2,\) for worlds \[0, 1\]; return one of \(2, 2\)"):
        Flat(2).reset(seed=0)
    vector = Scalar(2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.step(np.zeros((2, 1)))
    vector.reset(seed=0)
    with pytest.raises(ValueError, match=r"reward: it is an array of shape \(\)"):
        vector.step(np.zeros((2, 1)))
    for method, returned, said in [
        ("observe", lambda worlds: np.full((len(worlds), 2), np.nan), "observe: the row of world 0 holds NaN"),
        ("observe", lambda worlds: [["a", "b"]] * len(worlds), "observe: its dtype is <U1; return numbers"),
        ("observe", lambda worlds: [[1.0], [1.0, 2.0]], "observe: it is no array"),
        ("reward", lambda actions: np.array([0.0, np.inf]), "reward: world 1's is inf"),
        ("terminated", lambda: np.array([0, 1]), "terminated: its dtype is int64; return bools"),
        ("info", lambda: {"seed": np.zeros(2)}, "info: give a dict of arrays by names that begin with no underscore"),
        ("info", lambda: {"_x": np.zeros(2)}, "info: give a dict of arrays by names that begin with no underscore"),
        ("draw", lambda random, world: None, "draw: it returns None; return a dict"),
    ]:
        faulty = Press(2)
        with pytest.raises((ValueError, TypeError), match=said):
            setattr(faulty, method, returned)
            faulty.reset(seed=0)
            faulty.step(np.zeros((2, 1)))
    with pytest.raises(TypeError, match="action_space: it is a Dict"):
        SceneVectorEnv(scene(), interval=0.1, max_episode_steps=1, action_space=gymnasium.spaces.Dict(), observation_space=None)
    nested = gymnasium.spaces.Dict({"feet": gymnasium.spaces.MultiBinary(4)})
    with pytest.raises(TypeError, match="observation_space: its part 'feet' is a MultiBinary"):
        SceneVectorEnv(scene(), interval=0.1, max_episode_steps=1, action_space=gymnasium.spaces.Discrete(2), observation_space=nested)
    with pytest.raises(ValueError, match="overrides: give a dict, or a list of 2"):
        Press(2, overrides=[{}])
    with pytest.raises(ValueError, match="interval"):
        SceneVectorEnv(scene(), interval=0.0, max_episode_steps=1, action_space=None, observation_space=None)
    # What worlds run on is known when the environment is made.
    for machine, said in [({"backend": "cuda"}, "'cuda' is none; there are 'cpu'"), ({"precision": "f16"}, "'f16' is neither"), ({"threads": -1}, "-1 is no number")]:
        for make in (lambda: Press(2, **machine), lambda: gymnasium.make("barchan/SmoothSurface-v0", **machine)):
            with pytest.raises(ValueError, match=said):
                make()
    for arguments, said in [({"options": 3}, "options: 3 is no dict"), ({"seed": 1.5}, "seed: 1.5 is none")]:
        with pytest.raises((TypeError, ValueError), match=said):
            Press(2).reset(**arguments)
    with pytest.raises(NotImplementedError, match="SceneVectorEnv has no observe"):
        box = gymnasium.spaces.Box(-1.0, 1.0, (1,))
        SceneVectorEnv(scene(), interval=0.1, max_episode_steps=1, action_space=box, observation_space=box).reset(seed=0)
    pickle.loads(pickle.dumps(Press(2))).reset(seed=0)
    with pytest.raises(TypeError, match="pickled"):
        pickle.dumps(vector)


def test_the_example_in_the_documentation_works():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "environments.md").read_text(), re.DOTALL)
    [example] = [block for block in blocks if "SceneVectorEnv" in block]
    done = subprocess.run([sys.executable, "-W", "error", "-c", example], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
