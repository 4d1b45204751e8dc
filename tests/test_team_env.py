"""Worlds of teams: rigs of their own, padding, loads that can be held, followers as data of the algorithms."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plants import team
from tables import weekly

from mjxball import config as configs
from mjxball.algorithms import ALGORITHMS
from mjxball.config import Config, preset, with_plant
from mjxball.control import rotations
from mjxball.control.observation import ERROR, mount_angles
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, total_wrench
from mjxball.physics.step import make_accelerations, start_state
from mjxball.plant import plant_parameters
from mjxball.plant.teams import Factors, amplitudes_with_loss, padded, ring, ring_config, table, varied
from mjxball.plant.trim import largest_amplitude, safe_radius
from mjxball.sim.randomization import ResetDistribution
from mjxball.train import program as programs
from mjxball.train.environments import Agents, Environments
from mjxball.train.extensions import Extensions, find
from mjxball.train.program import TrainingProgram

PAPER = preset("paper")
SIZES = (2, 3, 4, 6)
QUIET = {
    "scenario.noise": (0.0, 0.0),
    "scenario.delay": (0.0, 0.0),
    "scenario.rotor_lag_scale": (1.0, 1.0),
    "follower.privileged_critic": False,
    "follower.observation_averages": (),
    "follower.recurrent_units": 0,
    "follower.previous_action": False,
    "reward.command_change": 0.0,
    "reward.spread": 0.0,
    "scenario.thrust_scale": (1.0, 1.0),
    **{f"scenario.{name}": (1.0, 1.0) for name in Factors._fields},
}


def settings(name: str = "team", **changes: Any) -> Config:
    dotted = {path.replace("__", "."): value for path, value in changes.items()}
    return configs.apply_overrides(preset(name), QUIET | dotted)


def blank(env: TransportEnv, *arguments: Any) -> Any:
    """A state of `env` with nothing but zeros, to be filled."""
    shapes = jax.eval_shape(env.reset, jax.random.PRNGKey(0), *arguments)
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


class TestRings:
    @pytest.mark.parametrize("count", [3, 4, 6])
    def test_they_are_the_shipped_teams(self, count: int) -> None:
        """To the six digits of the plant files."""
        mine, shipped = ring(with_plant(PAPER, "team6").plant, count), with_plant(PAPER, f"team{count}").plant
        for (name, found, _), (_, value, _) in zip(configs.leaves(mine), configs.leaves(shipped), strict=True):
            if isinstance(value, str):
                assert found == value
            elif name != "ball_stop":
                assert found == pytest.approx(value, rel=1e-4, abs=1e-6), name

    @pytest.mark.slow
    def test_a_padded_rig_moves_as_the_rig_itself(self) -> None:
        """The same commands to three drones, alone and with three that pad: the same accelerations."""
        config = settings(scenario__team_sizes=SIZES, scenario__cg_amplitude=(0.1, 0.1), scenario__start_tilt=0.3)
        env = TransportEnv(config, "newton-euler")
        state = jax.jit(env.reset)(jax.random.key(1), 1)
        world = state.pipeline_state
        own = ring_config(config, 3)
        alone = TransportEnv(own, "newton-euler")
        plant = world.plant._replace(rotor_force=world.plant.rotor_force[:3])
        still = jnp.zeros((2, 3))
        other = world._replace(loop=world.loop._replace(plant=plant), action=still, command=still, parameters=())
        action = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (5, 3)), jnp.float32)
        for _ in range(5):
            state = jax.jit(env.step)(state, action)
        seen = alone._loop_of(()).observe(plant, world.goal)
        moved = blank(alone).replace(pipeline_state=other, obs=seen)
        for _ in range(5):
            moved = jax.jit(alone.step)(moved, action[:2])
        mine, theirs = state.pipeline_state.plant, moved.pipeline_state.plant
        for name in ("position", "velocity", "quaternion", "rates"):
            np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), atol=2e-5)
        np.testing.assert_allclose(mine.rotor_force[:3], theirs.rotor_force, atol=1e-3)
        assert not mine.rotor_force[3:].any()
        np.testing.assert_allclose(state.obs[:2], moved.obs, atol=1e-4)
        np.testing.assert_allclose(state.reward[:2], moved.reward, rtol=1e-3)

    def test_factors_of_one_change_nothing_and_gains_follow_the_rig(self) -> None:
        plant, attitude = with_plant(PAPER, "team4").plant, with_plant(PAPER, "team4").attitude
        found = plant_parameters(plant, attitude)
        same = varied(found, Factors(), attitude, np.array(attitude.design_object_mass))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), same, found)
        wide = dataclasses.replace(
            plant, drones=tuple(dataclasses.replace(d, mount=tuple(1.5 * x for x in d.mount)) for d in plant.drones)
        )
        wider = varied(found, Factors(mount_scale=1.5), attitude, np.array(attitude.design_object_mass))
        np.testing.assert_allclose(wider.gains.kp, plant_parameters(wide, attitude).gains.kp, rtol=1e-12)
        assert padded(found, 6).load_share.sum() == pytest.approx(1.0)


def random_cases() -> list[tuple]:
    random, found = np.random.default_rng(5), []
    for number in range(60):
        count = int(random.integers(2, 7))
        plant = team(count, seed=number, cg_axis="xy", leader=int(random.integers(count)), rotor_force_max=9.0)
        thrust = random.uniform(0.9, 1.1, count) if number % 2 else np.ones(count)
        mass = random.uniform(0.1, 0.3) * count
        lost = [f for f in plant.followers if f == random.integers(count)] if count == 6 else []
        found.append((plant, mass, mass * random.uniform(0.8, 1.2), thrust, lost))
    return found


def test_the_safe_radius_is_safe_by_the_linear_program() -> None:
    """In 8 directions, for random mounts, leaders, masses that are not known, weak drones and lost ones."""
    held = 0
    for plant, mass, believed, thrust, lost in random_cases():
        flies = np.array([number not in lost for number in range(plant.count)], float)
        numbers = plant_parameters(plant, PAPER.attitude)
        radius = float(safe_radius(numbers, plant.leader, np.array(mass), 0.15, np.array(believed), thrust, flies))
        if radius <= 0:
            continue
        held += 1
        for angle in np.linspace(0, np.pi, 8, endpoint=False):
            direction = (np.cos(angle), np.sin(angle))
            bound = largest_amplitude(plant, mass, 0.15, direction, believed, lost, thrust=thrust)
            assert radius <= bound * (1 + 1e-9) + 1e-9
    assert held >= 20  # of 60


def test_the_safe_radius_of_three_drones_is_the_linear_programs_own() -> None:
    config = with_plant(PAPER, "team3")
    numbers = plant_parameters(config.plant, config.attitude)
    bound = min(largest_amplitude(config.plant, 0.3, 0.15, (np.cos(a), np.sin(a))) for a in np.linspace(0, 3.1, 32))
    assert float(safe_radius(numbers, 0, np.array(0.3), 0.15)) == pytest.approx(bound, rel=1e-3)


@pytest.fixture(scope="module")
def drawn() -> tuple[Config, Any, Any, Any]:
    """(config, load, plant, rig) of 400 worlds: rigs that differ, of which half of the largest lose a drone."""
    config = settings(
        scenario__drone_mass_scale=(0.8, 1.2),
        scenario__mount_scale=(0.8, 1.2),
        scenario__lost_follower_probability=0.4,
        scenario__lost_leader_probability=0.1,
    )
    sample = jax.jit(jax.vmap(ResetDistribution(config).sample))
    load, plant, _, rig = sample(jax.random.split(jax.random.key(0), 400), jnp.arange(400))
    assert rig is not None
    return config, load, plant, rig


class TestWorlds:
    def test_every_world_has_its_size_and_a_load_that_can_be_held(self, drawn: tuple[Config, Any, Any, Any]) -> None:
        config, load, plant, rig = drawn
        flies = np.asarray(rig.flies.sum(axis=1), int)
        np.testing.assert_array_equal(flies, np.resize(SIZES, 400))
        lifted = np.asarray(plant.rotor_force).sum(axis=(1, 2))
        own = rig.parameters
        weight = 9.81 * (np.asarray(own.drone_mass).sum(axis=1) + np.asarray(own.carrier_mass) + load.object_mass)
        np.testing.assert_allclose(lifted, weight, rtol=1e-5)
        assert (np.asarray(plant.rotor_force).any(axis=2).sum(axis=1) == flies).all()
        radius = np.asarray(rig.parameters.ball_limit) + config.plant.ball_radius
        time = jnp.linspace(0.0, 30.0, 200)
        path = jax.vmap(lambda one, t: jax.vmap(lambda s: paths(config, s, one))(t), in_axes=(0, None))
        offset = jax.jit(path)(load, time)
        far = np.linalg.norm(np.asarray(offset), axis=-1).max(axis=1)
        safe = jax.jit(jax.vmap(lambda n, m: safe_radius(n, 0, m, 0.15)))(own, load.object_mass)
        assert (far <= np.minimum(radius, safe) * (1 + 1e-4)).all()
        assert 0.1 < np.median(far / radius) < 0.9
        scales = np.asarray(own.drone_mass[:, 0])
        assert 0.8 <= scales.min() < 0.83
        assert 1.17 < scales.max() <= 1.2

    def test_a_drone_is_lost_at_the_share_that_was_asked_for(self, drawn: tuple[Config, Any, Any, Any]) -> None:
        config, load, _, rig = drawn
        stops = np.isfinite(np.asarray(load.stop_time))
        six = np.asarray(rig.flies).sum(axis=1) == 6
        assert 0.35 < stops[six].any(axis=1).mean() < 0.65
        # What is left of smaller teams cannot be trimmed beside a leader at hover thrust.
        assert not stops[~six, 1:].any()
        assert stops.sum(axis=1).max() == 1
        masses, table = amplitudes_with_loss(config)
        lost = stops.any(axis=1) & six
        held = [
            np.interp(mass, masses, row)
            for mass, row in zip(load.object_mass[lost], table[-1][stops[lost].argmax(axis=1)], strict=True)
        ]
        assert (
            np.asarray(load.cg_amplitude)[lost] <= np.array(held) * np.asarray(rig.proportion)[lost] * (1 + 1e-4)
        ).all()
        assert not (stops & (np.asarray(rig.flies) == 0)).any()
        assert stops[:, [0, 5]].any(axis=0).all()  # the leader too

    def test_every_follower_sees_its_own_errors_and_the_reward_is_its_own(self) -> None:
        env = TransportEnv(settings(scenario__noise=(1.0, 1.0)), "newton-euler")
        state = jax.jit(env.reset)(jax.random.key(0), 3)
        angles = mount_angles(env.config.plant)
        seen = rotations.turned_about_z(np.asarray(state.obs[:, ERROR], float), angles)
        assert np.abs(seen - seen[0]).max() < 0.03  # ten deviations of 3 mm
        assert np.abs(seen - seen[0]).max() > 1e-4
        action = jnp.zeros((5, 3)).at[2].set(1.0)
        after = jax.jit(env.step)(state, action)
        assert after.reward.shape == (5,)
        assert after.reward[2] < after.reward[0]
        assert after.reward[0] == after.reward[1]


def paths(config: Config, time: Any, load: Any) -> Any:
    from mjxball.physics.motion import make_cg_motion

    return make_cg_motion(config)(time, load).offset


class TestAgents:
    def test_slots_that_nobody_fills_are_no_data(self) -> None:
        agents = Agents(SIZES, 5, 22)
        assert agents.worlds == 8
        np.testing.assert_array_equal(agents.world[:11], [0, 1, 1, 2, 2, 2, 3, 3, 3, 3, 3])
        np.testing.assert_array_equal(agents.slot[:11], [0, 0, 1, 0, 1, 2, 0, 1, 2, 3, 4])
        np.testing.assert_array_equal(agents.table[1], [1, 2, 1, 1, 1])
        for agent in range(22):
            assert agents.table[agents.world[agent], agents.slot[agent]] == agent

    @pytest.mark.parametrize(
        ("sizes", "count", "turns"), [((2, 3, 4, 5, 6), 180, 6), ((2, 3, 4), 72, 6), ((2, 3, 4, 6), 44, 4)]
    )
    def test_worlds_of_every_size_take_turns_evenly(self, sizes: tuple[int, ...], count: int, turns: int) -> None:
        agents = Agents(sizes, 5, count)
        size = np.array(sizes)[np.arange(agents.worlds) % len(sizes)]
        turn = agents.turn[agents.first] % turns
        np.testing.assert_array_equal(agents.turn, agents.turn[agents.first][agents.world])
        for one in sizes:
            counts = np.bincount(turn[size == one], minlength=turns)
            assert counts.min() == counts.max() == count // (sum(sizes) - len(sizes)) // turns

    def test_a_count_that_fills_no_worlds_is_refused(self) -> None:
        with pytest.raises(InputError, match="multiple of 11"):
            Agents(SIZES, 5, 32)

    @pytest.mark.slow
    def test_actions_reach_their_followers_and_worlds_end_as_a_whole(self) -> None:
        config = settings(timing__episode_steps=3)
        env = TransportEnv(config, "newton-euler")
        environments = Environments(env, 11)
        states = jax.jit(environments.reset)(jax.random.PRNGKey(0))
        assert states.obs.shape == (11, env.observation_size)
        action = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (11, 3)), jnp.float32)
        step = jax.jit(environments.step)
        envs, transition = step(environments.begin(states), action, jax.random.PRNGKey(1))
        world = jax.tree.map(lambda leaf: leaf[3], states.pipeline_state)
        one = blank(env, 3).replace(pipeline_state=world, obs=states.obs[6:])
        alone = jax.jit(env.step)(one, action[6:])
        np.testing.assert_allclose(transition.next_observation[6:], alone.obs, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(transition.reward[6:], alone.reward, rtol=1e-4)
        for number in range(2):
            envs, transition = step(envs, action, jax.random.PRNGKey(3 + number))
        assert transition.done.all()
        assert not transition.terminated.any()
        assert (np.asarray(envs.states.pipeline_state.steps) == 0).all()
        assert len(np.unique(np.asarray(envs.states.pipeline_state.goal)[:, 0])) == 4


def test_no_tilt_and_no_rotor_pushes_a_free_ball_towards_the_middle() -> None:
    """A ball at rest on the plate: thrust is normal to it, so that its acceleration never points inwards."""
    config, random, count = configs.with_plant(preset("paper"), "plate4"), np.random.default_rng(0), 2000
    mass, none = np.full(count, config.plant.object_mass), np.zeros(count)
    tilt = 0.3 * random.normal(size=(count, 3))
    place, zero = random.uniform(-0.08, 0.08, (count, 2)), np.zeros((count, 3))
    state = start_state(config, zero, tilt, zero, mass, place)._replace(
        rates=random.normal(size=(count, 3)), rotor_force=random.uniform(0, 8, (count, 4, 4))
    )
    numbers = plant_parameters(config.plant, config.attitude)
    wrench = total_wrench(config.plant, numbers, state.rotor_force)
    accelerate = make_accelerations(config, newton_euler.make_engine(config.plant, config.attitude))
    load = Load(mass, mass, none, none, none, np.zeros((count, 0)), np.zeros((count, 0)))
    _, _, ball = accelerate(state, wrench, load)
    assert ((ball * place).sum(axis=-1) >= -1e-12).all()
    assert np.abs(ball).max() > 0.1  # [m/s2], outwards


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"scenario.team_sizes": (2, 8)}, "has 6"),
        ({"plant.cg_axis": "x", "scenario.cg_width": (0.0, 0.0)}, "in the plane"),
        ({"follower.load_axis_only": True}, "along a line"),
    ],
)
def test_unsound_teams_are_refused(changes: dict, word: str) -> None:
    with pytest.raises(InputError, match=word):
        configs.validate(configs.apply_overrides(preset("team"), changes))


def test_the_table_of_rigs_has_one_row_for_each_size() -> None:
    found = table(preset("team"))
    assert found.mounts.shape == (4, 6, 3)
    np.testing.assert_array_equal((found.drone_mass > 0).sum(axis=1), SIZES)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["sac", *weekly("ppo", "gradient")])
def test_every_algorithm_learns_from_all_followers(algorithm: str) -> None:
    """A few steps of each: 6 followers in four worlds, half of them padded; finite numbers, weights that move."""
    sizes = {"num_envs": 6, "policy_layers": (8,)}
    own = {
        "sac": {"batch_size": 6, "replay_size": 600, "warmup_steps": 12, "total_steps": 120, "critic_layers": (8,)},
        "ppo": {"minibatches": 1, "unroll_length": 5, "total_steps": 120},
        "gradient": {"gradient_steps": 3, "horizon": 5},
    }[algorithm]
    changes = {f"{algorithm}.{name}": value for name, value in (sizes | own).items()}
    config = configs.apply_overrides(ring_config(settings(), 3), {"scenario.team_sizes": (2, 3)} | changes)
    kind = find(ALGORITHMS[algorithm], "--algorithm")
    program = TrainingProgram(config, "newton-euler", extensions=Extensions(algorithm=kind))
    state = jax.jit(program.create)(jax.random.PRNGKey(0))
    before = program.policy(state).layers
    advance = jax.jit(program.advance)
    state, _, _ = advance(state, programs.warmup_mode(10))
    state, statistics, metrics = advance(state, programs.train_mode(10))
    after = program.policy(state).layers
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((after, metrics, statistics)))
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), before, after)
    assert max(jax.tree.leaves(moved)) > 0
    assert statistics.peaks["error"].shape == (6,)


@pytest.mark.release  # of plants, tests/physics
def test_padded_worlds_move_alike_on_mjx_and_in_closed_form() -> None:
    """One world of each size, rigs of their own, 20 control steps in float32."""
    plants, keys = [], jax.random.split(jax.random.key(0), len(SIZES))
    envs = [TransportEnv(preset("team"), engine) for engine in ("mjx", "newton-euler")]
    start = jax.jit(jax.vmap(envs[0].reset, in_axes=(0, 0)))(keys, jnp.arange(len(SIZES)))
    for env in envs:
        state, step = start, jax.jit(jax.vmap(env.step))
        answer = jnp.zeros((len(SIZES), 5, env.action_size)).at[..., :3].set(0.3)
        for _ in range(20):
            state = step(state, answer)
        plants.append(state.pipeline_state.plant)
    for name in ("position", "velocity", "quaternion", "rates"):
        np.testing.assert_allclose(getattr(plants[0], name), getattr(plants[1], name), rtol=0, atol=2e-5)


@pytest.mark.parametrize("size", [2, 3, 4, 6])
def test_the_spread_of_commands_is_what_moves_nothing(size: int) -> None:
    """Vertical commands against NumPy's least squares: those that lie in a plane over the mounts turn the load."""
    env = TransportEnv(settings(scenario__team_sizes=SIZES), "newton-euler")
    rig = env.reset(jax.random.key(0), SIZES.index(size)).pipeline_state.parameters
    flying, random = size - 1, np.random.default_rng(size)
    mounts, commands = np.asarray(rig.mounts)[1:, :2], random.normal(size=(5, 3))
    assert np.abs(mounts[:flying]).max() > 0.1
    plane = np.concatenate([np.ones((5, 1)), mounts], axis=1)[:flying]
    solved = plane @ np.linalg.lstsq(plane, commands[:flying, 2], rcond=1e-6)[0]
    wanted = np.zeros((5, 3))
    wanted[:flying, :2] = commands[:flying, :2] - commands[:flying, :2].mean(axis=0)
    wanted[:flying, 2] = commands[:flying, 2] - solved
    np.testing.assert_allclose(env._spread(jnp.asarray(commands), rig), wanted, atol=2e-6)  # float32
    assert (np.abs(wanted[:, 2]).max() > 0.1) == (size > 4)  # up to three lie in a plane
