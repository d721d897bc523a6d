"""Tasks as environments: what Gymnasium's users can count on."""

import _thread
import json
import multiprocessing
import pickle
import subprocess
import sys
import threading
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import barchan
from barchan import envs

TASKS = list(barchan.registry()["tasks"])
LITE = [name for name in TASKS if name.endswith("-lite")]
TASK = "SmoothSurface-lite"
ID = f"barchan/{TASK}-v0"


@pytest.fixture(autouse=True)
def no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def actions_of(vector, steps, seed=3):
    """Actions within the limits."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *vector.action_space.shape)).astype(np.float32)


def test_every_task_is_registered():
    for name in TASKS:
        spec = gymnasium.spec(f"barchan/{name}-v0")
        assert spec.vector_entry_point == "barchan.envs:TaskVectorEnv"
        described = barchan.task(name)
        assert described.name == name and described.horizon > 0 and described.observation_size > 0
        assert len(described.action_names) == len(described.action_low) == len(described.action_high)
        assert np.all(described.action_low < described.action_high)
    # In a process that has not imported it, too.
    code = f"import gymnasium; print(gymnasium.make('barchan.envs:{ID}').unwrapped.task.name)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == TASK


@pytest.mark.parametrize("name", LITE)
def test_gymnasiums_checker_finds_nothing(name):
    environment = gymnasium.make(f"barchan/{name}-v0").unwrapped
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(environment)
    # Velocities are in the observation, and have no bounds.
    unexpected = [str(one.message) for one in said if "infinity" not in str(one.message) and "pkg_resources" not in str(one.message)]
    assert not unexpected
    environment.close()


def test_the_same_seed_gives_the_same_trajectory():
    environment = gymnasium.make(ID, randomise=1.0)
    given = np.random.default_rng(0).uniform(-1, 1, (5, 4)).astype(np.float32)

    def trajectory(seed):
        first, info = environment.reset(seed=seed)
        steps = [environment.step(action) for action in given]
        return info["seed"], np.array([first, *(step[0] for step in steps)]), np.array([step[1] for step in steps])

    seed, seen, rewards = trajectory(7)
    assert seed == 7 and seen.dtype == np.float32 and np.all(np.any(np.diff(seen, axis=0), axis=1))
    again = trajectory(7)
    np.testing.assert_array_equal(seen, again[1])
    np.testing.assert_array_equal(rewards, again[2])
    other, elsewhere, _ = trajectory(None)
    assert other != 7 and np.any(elsewhere[0] != seen[0])
    # Where seeds change nothing of the task, the episode begins again.
    plain = gymnasium.make(ID)
    first, _ = plain.reset(seed=7)
    second, info = plain.reset()
    assert info["seed"] == 7
    np.testing.assert_array_equal(first, second)


def test_worlds_of_a_vector_are_what_they_are_alone():
    vector = gymnasium.make_vec(ID, num_envs=3, randomise=1.0)
    assert isinstance(vector, envs.TaskVectorEnv)
    seen, info = vector.reset(seed=5)
    assert vector.np_random_seed == (5, 6, 7) and len(vector.np_random) == 3
    assert seen.shape == vector.observation_space.shape and info["seed"].tolist() == [5, 6, 7]
    alone = [gymnasium.make(ID, randomise=1.0) for _ in range(3)]
    for world, one in enumerate(alone):
        np.testing.assert_array_equal(one.reset(seed=5 + world)[0], seen[world])
    for actions in actions_of(vector, 4):
        seen, rewards, terminated, truncated, info = vector.step(actions)
        for world, one in enumerate(alone):
            observation, reward, end, cut, told = one.step(actions[world])
            np.testing.assert_array_equal(observation, seen[world])
            assert (reward, end, cut) == (rewards[world], terminated[world], truncated[world])
            assert all(info[name][world] == value for name, value in told.items())


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_episodes_begin_anew_as_gymnasiums_own_vectors_do_it(mode):
    options = {"num_envs": 2, "max_episode_steps": 3, "randomise": 1.0}
    ours = gymnasium.make_vec(ID, autoreset_mode=mode, **options)
    theirs = gymnasium.make_vec(ID, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    np.testing.assert_array_equal(ours.reset(seed=1)[0], theirs.reset(seed=1)[0])
    ended = 0
    for actions in actions_of(ours, 8):
        step, expected = ours.step(actions), theirs.step(actions)
        for a, b in zip(step[:4], expected[:4]):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        info, told = step[4], expected[4]
        assert ("final_obs" in info) == ("final_obs" in told)
        if "final_obs" in told:
            np.testing.assert_array_equal(np.stack(info["final_obs"]), np.stack(told["final_obs"]))
            assert info["final_info"]["success"].tolist() == told["final_info"]["success"].tolist()
        if "_seed" in told:
            assert info["seed"][told["_seed"]].tolist() == told["seed"][told["_seed"]].tolist()
        ended += int(step[3].any())
    assert ended == 2


def test_ended_worlds_wait_if_nobody_resets_them():
    vector = envs.TaskVectorEnv(TASK, 2, autoreset_mode="Disabled", max_episode_steps=2)
    vector.reset(seed=0)
    for number, actions in enumerate(actions_of(vector, 4)):
        _, rewards, _, truncated, info = vector.step(actions)
        assert np.all(truncated == (number >= 1)) and (number < 2 or not rewards.any())
        assert np.all(info["_success"] == (number < 2))
    # They take no steps.
    assert vector.worlds.steps_taken.tolist() == [2, 2]
    seen, _ = vector.reset(options={"reset_mask": np.array([True, False])})
    after, _, _, truncated, _ = vector.step(actions)
    assert truncated.tolist() == [False, True] and vector.worlds.steps_taken.tolist() == [1, 2]
    np.testing.assert_array_equal(after[1], seen[1])
    assert np.any(after[0] != seen[0])
    with pytest.raises(ValueError, match="reset_mask"):
        vector.reset(options={"reset_mask": [1, 0]})


def test_all_worlds_are_of_one_simulation(monkeypatch):
    made = []

    def counted(*arguments, **options):
        made.append(barchan.Environment(*arguments, **options))
        return made[-1]

    monkeypatch.setattr(envs, "Environment", counted)
    vector = gymnasium.make_vec(ID, num_envs=4)
    vector.reset(seed=0)
    vector.step(vector.action_space.sample())
    vector.reset(seed=9)
    assert len(made) == 1 and made[0].worlds == 4 and vector.worlds is made[0]


def test_wrong_actions_are_named():
    environment = gymnasium.make(ID, disable_env_checker=True).unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        environment.step(np.zeros(4, np.float32))
    environment.reset(seed=0)
    with pytest.raises(barchan.BodyError, match=r"action: dz \[m\] is nan; give a number from -1 to 1"):
        environment.step(np.array([0, 0, np.nan, 0], np.float32))
    with pytest.raises(barchan.BodyError, match=r"its shape is \(3,\); give \(4,\): dx \[m\], dy"):
        environment.step(np.zeros(3, np.float32))
    with pytest.raises(TypeError, match="dtype is <U1"):
        environment.step(np.array(["a"] * 4))
    with pytest.raises(TypeError, match="dtype is complex"):
        environment.step(np.zeros(4, complex))
    assert environment.worlds.steps_taken[0] == 0
    # What lies beyond the limits is cut off and counted.
    assert environment.step(np.array([2.0, 0, 0, -1.5]))[4]["clipped"] == 2
    assert environment.step(np.array([1.0, -1.0, 0, 0]))[4]["clipped"] == 2
    vector = envs.TaskVectorEnv(TASK, 2)
    vector.reset(seed=0)
    with pytest.raises(barchan.BodyError, match=r"world 1: dx \[m\] is inf"):
        vector.step(np.array([[0, 0, 0, 0], [np.inf, 0, 0, 0]]))
    with pytest.raises(barchan.UnknownNameError, match="SmoothSurface-lite"):
        envs.TaskEnv("SmoothSurfaces")
    with pytest.raises(barchan.BarchanError, match="randomise"):
        envs.TaskEnv(TASK, randomize=1.0)
    with pytest.raises(ValueError, match="render_mode"):
        envs.TaskEnv(TASK, render_mode="ascii")
    for options in ({"num_envs": 0}, {"max_episode_steps": 0}, {"max_episode_steps": 2.5}):
        with pytest.raises(ValueError, match=next(iter(options))):
            envs.TaskVectorEnv(TASK, **options)


def test_an_episode_can_begin_elsewhere_and_its_world_be_read():
    worlds = barchan.Environment("QuadrupedWalk-lite", worlds=2, seed=0)
    first = worlds.reset()
    (name, dog), = worlds.simulation(1).robots().items()
    seen = worlds.place(name, joints=dog.joint_position + 0.1, joint_rates=np.ones(12), worlds=1)
    np.testing.assert_array_equal(seen[0], first[0])
    assert np.any(seen[1] != first[1]) and not worlds.steps_taken.any()
    copy = worlds.simulation(1)
    there = copy.robots()[name]
    np.testing.assert_allclose(there.joint_position, dog.joint_position + 0.1, atol=1e-12)
    np.testing.assert_array_equal(there.joint_rate, np.ones(12))
    assert len(copy.particles()) == worlds.particle_counts[1] and "QuadrupedWalk-lite" in copy.scene()
    # What is done to the copy, the episode does not notice.
    copy.push(name, [5, 0, 0])
    np.testing.assert_array_equal(worlds.observations(), seen)
    worlds.step(worlds.heuristic())
    np.testing.assert_array_equal(worlds.reset(), first)
    # A world that refuses leaves no other one in an episode that has not begun.
    worlds.step(worlds.heuristic())
    with pytest.raises(barchan.BodyError, match="world 1: .*limits"):
        worlds.place(name, joints=[dog.joint_position - 0.1, np.full(12, 9.0)])
    assert not worlds.steps_taken.any()
    with pytest.raises(IndexError, match="world 2"):
        worlds.simulation(2)
    with pytest.raises(ValueError, match="world 1 is there twice"):
        worlds.reset([0, 1, 1], seeds=[1, 2, 3])


def test_a_reset_of_some_worlds_tells_the_others_as_they_are():
    vector = envs.TaskVectorEnv(TASK, 2, autoreset_mode="Disabled")
    vector.reset(seed=0)
    vector.step(np.zeros((2, 4)))
    expected = vector.worlds.step(np.tile(vector.task.action_high, (2, 1)))[0]
    observed, _ = vector.reset(options={"reset_mask": np.array([True, False])})
    assert np.array_equal(observed[1], expected[1]) and not np.array_equal(observed[0], expected[0])
    with pytest.raises(ValueError, match="options: 'level' mean nothing here"):
        envs.TaskEnv(TASK).reset(options={"level": 3})


def test_a_wrong_seed_leaves_the_environment_as_it_was():
    one = envs.TaskEnv(TASK)
    assert one.reset(seed=7)[1] == {"seed": 7}
    vector = envs.TaskVectorEnv(TASK, 3)
    vector.reset(seed=10)
    for wrong in (2**63, 2**64, -1, 1.5, True):
        with pytest.raises((ValueError, gymnasium.error.Error), match="seed"):
            one.reset(seed=wrong)
        with pytest.raises(ValueError, match="seed"):
            vector.reset(seed=[100, wrong, 102])
    with pytest.raises(ValueError, match="seed"):
        vector.reset(seed=2**63 - 1)
    assert one.reset()[1] == {"seed": 7} and vector.reset()[1]["seed"].tolist() == [10, 11, 12]
    # NumPy's whole numbers are whole numbers.
    assert one.reset(seed=np.int64(8))[1] == {"seed": 8}
    assert vector.reset(seed=list(np.arange(3)))[1]["seed"].tolist() == [0, 1, 2]


def test_actions_may_be_in_the_tasks_units_or_added_to_the_agents():
    described = barchan.task(TASK)
    unit, units, added = envs.TaskEnv(TASK), envs.TaskEnv(TASK, units=True), envs.TaskEnv(TASK, residual=0.5)
    np.testing.assert_array_equal(units.action_space.high, described.action_high.astype(np.float32))
    for one in (unit, units, added):
        one.reset(seed=0)
    # Limits in float32 may be a little wider.
    pressed = envs.TaskEnv("PressMould-lite", units=True)
    pressed.reset(seed=0)
    assert pressed.step(pressed.action_space.high)[4]["clipped"] == 0
    share = np.array([0.5, -0.25, 0.0, 1.0])
    seen = unit.step(share)[0]
    np.testing.assert_array_equal(units.step(share * described.action_high)[0], seen)
    units.reset()
    agent = units.heuristic()
    np.testing.assert_array_equal(added.heuristic(), 0.0)
    np.testing.assert_allclose(added.step(np.full(4, 0.1))[0], units.step(agent + 0.05 * described.action_high)[0], atol=1e-6)


def test_environments_are_pickled_before_they_begin():
    for environment in (envs.TaskEnv(TASK, randomise=0.5), envs.TaskVectorEnv(TASK, 2)):
        copy = pickle.loads(pickle.dumps(environment))
        np.testing.assert_array_equal(copy.reset(seed=3)[0], environment.reset(seed=3)[0])
        with pytest.raises(TypeError, match="before its first reset"):
            pickle.dumps(environment)
    with pytest.raises(TypeError, match="Environment cannot be pickled"):
        pickle.dumps(environment.worlds)


def play(seed):
    """What another process makes of it."""
    environment = gymnasium.make(ID)
    environment.reset(seed=seed)
    return environment.step(np.full(4, 0.5, np.float32))[0]


def test_it_works_in_spawned_processes():
    here = play(4)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        np.testing.assert_array_equal(pool.apply(play, (4,)), here)
    several = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    several.reset(seed=4)
    seen = several.step(np.full((2, 4), 0.5, np.float32))[0]
    np.testing.assert_array_equal(seen[0], here)
    several.close()


def test_an_episode_is_written_and_can_be_played_again(tmp_path):
    vector = envs.TaskVectorEnv(TASK, 2, randomise=1.0)
    vector.reset(seed=11)
    rewards = [vector.step(actions)[1][1] for actions in actions_of(vector, 5)]
    vector.save_episode(tmp_path / "episode.json", world=1, agent="nobody")
    written = json.loads((tmp_path / "episode.json").read_text())
    assert written["task"] == TASK and written["seed"] == 12 and written["agent"] == "nobody"
    assert written["rewards"] == rewards and written["parameters"] == {"randomise": 1.0}
    again = barchan.Environment(TASK, seed=12, parameters=written["parameters"])
    assert [again.step([action])[1][0] for action in written["actions"]] == rewards
    with pytest.raises(barchan.FileError, match="none"):
        vector.save_episode(tmp_path / "none" / "episode.json")


def test_pictures_and_windows(monkeypatch):
    environment = gymnasium.make(ID, render_mode="rgb_array")
    environment.reset(seed=0)
    first = environment.render()
    environment.step(np.ones(4, np.float32))
    second = environment.render()
    assert first.dtype == np.uint8 and first.shape == second.shape and first.shape[2] == 3 and np.any(first != second)
    vector = gymnasium.make_vec(ID, num_envs=2, render_mode="rgb_array")
    vector.reset(seed=0)
    assert len(vector.render()) == 2
    shown = gymnasium.make(ID, render_mode="human")
    shown.reset(seed=0)
    shown.step(np.ones(4, np.float32))
    assert shown.render() is None
    shown.close()
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    blind = gymnasium.make(ID, render_mode="human")
    with pytest.raises(barchan.DisplayError, match="rgb_array"):
        blind.reset(seed=0)


def test_the_bare_environment():
    worlds = barchan.Environment(TASK, worlds=2, seed=[3, 9])
    assert repr(worlds) == f"<barchan.Environment of '{TASK}': 2 worlds, cpu f32>"
    assert worlds.seeds.tolist() == [3, 9] and worlds.particle_counts.min() > 1000
    start = worlds.observations()
    agent = worlds.heuristic()
    assert start.shape == (2, worlds.task.observation_size) and start.dtype == np.float32 and agent.shape == (2, 4)
    seen, rewards, terminated, truncated, success, info = worlds.step(agent)
    assert rewards.dtype == np.float64 and {terminated.dtype, truncated.dtype, success.dtype} == {np.dtype(bool)}
    assert all(values.shape == (2,) for values in info.values())
    assert worlds.stepping_seconds > 0.0 and worlds.failures == [None, None]
    with pytest.raises(barchan.BodyError, match=r"world 1: dy \[m\] of the action is NaN"):
        worlds.step([[0, 0, 0, 0], [0, np.nan, 0, 0]])
    with pytest.raises(ValueError, match=r"give \(2, 4\), a row for each world: dx \[m\]"):
        worlds.step(np.zeros(4))
    np.testing.assert_array_equal(worlds.observations(), seen)
    # One that waits is as it was, whatever it is told.
    later, rewards = worlds.step(agent, waiting=[False, True])[:2]
    np.testing.assert_array_equal(later[1], seen[1])
    assert np.any(later[0] != seen[0]) and rewards[1] == 0.0 and worlds.steps_taken.tolist() == [2, 1]
    with pytest.raises(ValueError, match="1 of them for 2"):
        worlds.step(agent, waiting=[True])
    np.testing.assert_array_equal(worlds.reset(1)[1], start[1])
    assert worlds.steps_taken.tolist() == [2, 0]
    with pytest.raises(IndexError, match="no world 2"):
        worlds.render(2)
    with pytest.raises(ValueError, match="seeds"):
        worlds.reset(seeds=[1])
    with pytest.raises(ValueError, match="failures"):
        barchan.Environment(TASK, failures="ignore")
    for wrong in (True, [True, False]):
        with pytest.raises(TypeError, match="seeds are whole numbers"):
            barchan.Environment(TASK, worlds=2, seed=wrong)


def test_a_scene_of_ones_own_is_played(tmp_path):
    scene = tmp_path / "own.toml"
    scene.write_text(OWN)
    assert barchan.task(str(scene)).name == barchan.task(scene).name == "QuadrupedWalk"
    worlds = barchan.Environment(scene, seed=3)
    _, rewards, _, _, _, info = worlds.step(np.zeros((1, 12)))
    assert 4.9 < rewards[0] < 5.0
    # It is pushed on.
    worlds.push("it", [0.0, 40.0, 0.0])
    info = [worlds.step(np.zeros((1, 12)))[5] for _ in range(5)][-1]
    assert info["off the line [m]"][0] > 0.05
    gym = envs.TaskEnv(scene)
    assert gym.reset(seed=1)[0].shape == (worlds.task.observation_size,)
    gym.worlds.push("it", [0.0, 40.0, 0.0])
    assert barchan.task(str(scene), {"observation": "heights"}).observation_size > worlds.task.observation_size
    scene.write_text(OWN.replace("[task]", "[other]"))
    with pytest.raises(barchan.BarchanError, match="other"):
        barchan.Environment(str(scene))


OWN = """
name = "own"
world = { cell = 0.1, min = [-20, -20, 0], max = [20, 20, 2], walls = { z_min = "stick" } }
time = { end = 20, step = 2e-3 }
[task]
name = "QuadrupedWalk"
[[robot]]
name = "it"
model = "quadruped"
position = [0, 0, 0.4]
joints = { "*_calf_joint" = -1.6, "*_thigh_joint" = 0.8 }
motor = [{ kp = 250, kd = 5 }]
[robot.motion.gait]
feet = { FL_foot = 0.0, RR_foot = 0.0, FR_foot = 0.5, RL_foot = 0.5 }
period = 0.4
stride = [0.2, 0.0, 0.0]
lift = 0.05
"""


def test_ctrl_c_ends_a_control_step():
    worlds = barchan.Environment("SmoothSurface")
    still = np.zeros((1, 4))
    timer = threading.Timer(0.1, _thread.interrupt_main)
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        for _ in range(1000):
            worlds.step(still)
    timer.join()
    worlds.reset()
    assert worlds.step(still)[1].shape == (1,)
