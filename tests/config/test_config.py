"""Configuration: JSON round trip, hash, overrides from text, and everything that validation must refuse."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import pytest
from tables import rows

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.policy.file import load_file

PATHS = [path for path, _, _ in configs.leaves(Config())]
each_preset = rows("name", configs.PRESETS)
each_leaf = rows("path", PATHS)


def value_at(config: Config, path: str) -> Any:
    return {known: value for known, value, _ in configs.leaves(config)}[path]


def another(value: Any) -> Any:
    """A value of the same type that differs."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return (another(value[0]), *value[1:]) if value else (3,)
    return value + 1 if isinstance(value, (int, float)) else f"{value}!"


def text_of(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def refusal(config: Config) -> str:
    """The one sentence with which `config` is refused."""
    with pytest.raises(InputError) as error:
        configs.validate(config)
    assert str(error.value).isprintable()
    return str(error.value)


class TestJson:
    @each_preset
    def test_every_preset_is_valid_and_named(self, name):
        assert configs.validate(configs.preset(name)).preset == name

    @each_preset
    def test_round_trip(self, name):
        config = configs.preset(name)
        assert configs.from_dict(json.loads(configs.to_json(config))) == config

    def test_whole_numbers_for_floats_are_read_as_floats(self):
        data = configs.to_dict(configs.preset("paper"))
        data["plant"]["drones"][0]["mass"] = 1
        config = configs.from_dict(json.loads(json.dumps(data)))
        assert configs.config_hash(config) == configs.config_hash(configs.preset("paper"))

    def test_unknown_preset_lists_the_known(self):
        with pytest.raises(InputError, match="transport") as error:
            configs.preset("papper")
        assert "papper" in str(error.value)

    @rows(
        ("change", "named"),
        [
            (lambda data: data.update(wings=2), "wings"),
            (lambda data: data["plant"].update(wings=2), "wings"),
            (lambda data: data["plant"].pop("arm"), "arm"),
            (lambda data: data.pop("sac"), "sac"),
            (lambda data: data.update(sac=3), "sac"),
        ],
    )
    def test_other_fields_are_named(self, change, named):
        data = configs.to_dict(configs.preset("paper"))
        change(data)
        with pytest.raises(InputError, match=named):
            configs.from_dict(data)

    @rows("data", [None, [], 3, "paper"])
    def test_not_an_object(self, data):
        with pytest.raises(InputError):
            configs.from_dict(data)

    @rows(
        ("section", "leaf", "value"),
        [
            ("plant.drones.0", "mass", "heavy"),
            ("plant.drones.0", "mass", True),
            ("plant.drones.0", "mass", None),
            ("plant.drones.0", "mass", [1.0]),
            ("plant.drones.0", "inertia", 0.01),
            ("plant.drones.0", "inertia", [0.01, "x", 0.01]),
            ("plant.drones.0", "inertia", [[1, 1, 1]]),
            ("sac", "num_envs", 12.5),
            ("sac", "updates_per_step", 2.5),
            ("sac", "policy_layers", [64, 2.5]),
            ("sac", "policy_layers", 64),
            ("sac", "alpha_fixed", "no"),
            ("sac", "alpha_fixed", 0.5),
            ("reward", "kind", 3),
            ("reward", "kind", ["task"]),
        ],
    )
    def test_wrong_type_is_refused_and_named(self, section, leaf, value):
        """A `config.json` edited by hand: JSON holds any type anywhere."""
        data = configs.to_dict(configs.preset("transport"))
        part: Any = data
        for step in section.split("."):
            part = part[int(step) if step.isdigit() else step]
        part[leaf] = value
        with pytest.raises(InputError, match=leaf) as error:
            configs.validate(configs.from_dict(json.loads(json.dumps(data))))
        assert str(error.value).isprintable()


class TestHash:
    @each_leaf
    def test_changes_with_every_leaf(self, path):
        config = Config()
        changed = configs.replace(config, path, another(value_at(config, path)))
        assert configs.config_hash(changed) != configs.config_hash(config)

    def test_does_not_depend_on_how_the_config_was_made(self):
        config = configs.preset("transport")
        again = configs.from_dict(json.loads(configs.to_json(config)))
        assert configs.config_hash(again) == configs.config_hash(config)

    def test_is_sixteen_hex_digits(self):
        text = configs.config_hash(Config())
        assert len(text) == 16
        int(text, 16)

    def test_presets_differ(self):
        assert len({configs.config_hash(config) for config in configs.PRESETS.values()}) == len(configs.PRESETS)


class TestOverride:
    @each_preset
    @each_leaf
    def test_text_of_every_leaf_gives_it_back(self, name, path):
        config = configs.preset(name)
        assert configs.override(config, path, text_of(value_at(config, path))) == config

    @each_leaf
    def test_every_leaf_can_be_changed(self, path):
        config = Config()
        wanted = another(value_at(config, path))
        assert value_at(configs.override(config, path, text_of(wanted)), path) == wanted

    @rows(("text", "value"), [("true", True), ("False", False), ("1", True), ("0", False)])
    def test_switches(self, text, value):
        assert configs.override(Config(), "sac.alpha_fixed", text).sac.alpha_fixed is value

    def test_numbers_of_drones_are_whole(self):
        assert str(configs.override(Config(), "scenario.team_sizes", "2,4").scenario.team_sizes) == "(2, 4)"
        with pytest.raises(InputError, match="whole numbers"):
            configs.override(Config(), "scenario.team_sizes", "2.5")

    def test_layers_may_have_any_number(self):
        assert configs.override(Config(), "sac.policy_layers", "32,16,8").sac.policy_layers == (32, 16, 8)

    def test_original_stays(self):
        config = Config()
        configs.override(config, "plant.arm", "0.2")
        assert config == Config()

    @rows("path", ["plant.wings", "plant", "arm", "", "plant.arm.x", "preset"])
    def test_unknown_path(self, path):
        with pytest.raises(InputError, match="not a setting"):
            configs.override(Config(), path, "1")

    @rows(
        ("path", "text"),
        [
            ("plant.arm", "long"),
            ("plant.arm", ""),
            ("plant.arm", "0.1,0.2"),
            ("sac.num_envs", "12.5"),
            ("sac.num_envs", "1e3"),
            ("plant.drones.0.inertia", "1,2,x"),
            ("plant.drones.0.inertia", "1;2;3"),
            ("sac.policy_layers", "64,"),
            ("sac.alpha_fixed", "maybe"),
        ],
    )
    def test_text_that_does_not_parse(self, path, text):
        with pytest.raises(InputError, match=path.replace(".", r"\.")) as error:
            configs.override(Config(), path, text)
        assert repr(text) in str(error.value)


def test_drones_are_lost_of_teams_whose_trim_is_known_without_them() -> None:
    for start, name, said in (
        ("lost", "leader", "exceed 1 together"),
        ("universal", "leader", "not for random rigs"),
        ("paper", "follower", "three drones or more"),
    ):
        config = configs.replace(configs.preset(start), f"scenario.lost_{name}_probability", 0.9)
        assert said in refusal(config)


class TestValidate:
    @rows(
        ("path", "value"),
        [
            ("plant.drones.0.mass", -1.0),
            ("plant.object_mass", 0.0),
            ("plant.drones.0.inertia", (1e-3, -1e-3, 1e-3)),
            ("plant.drones.0.inertia", (1e-3, 1e-3)),
            ("plant.rotor_lag", 0.0),
            ("plant.gravity", -9.81),
            ("command.tilt_limit", 1.3),
            ("leader.kp", (0.5, -0.5, 0.5)),
            ("follower.action", "indirect"),
            ("timing.control_period", 0.0),
            ("timing.episode_steps", 0),
            ("scenario.object_mass", (0.3, 0.1)),
            ("scenario.object_mass", (0.0, 0.1)),
            ("scenario.cg_speed", (0.1, 0.2, 0.3)),
            ("reward.kind", "fun"),
            ("reward.error_scale", 0.0),
            ("sac.discount", 1.0),
            ("sac.batch_size", 0),
            ("sac.policy_layers", ()),
            ("sac.policy_layers", (64, 0)),
            ("sac.alpha", 0.0),
            ("sac.tau", 1.5),
        ],
    )
    def test_leaf_out_of_bounds_is_named(self, path, value):
        assert path in refusal(configs.replace(Config(), path, value))

    @rows("path, number", list(zip(PATHS, itertools.cycle([float("nan"), float("inf"), float("-inf")]), strict=False)))
    def test_every_number_must_be_finite(self, path, number):
        value = value_at(Config(), path)
        if isinstance(value, (bool, str)):
            changed = number  # no number belongs here at all
        elif isinstance(value, tuple):
            changed = (number, *value[1:])
        else:
            changed = number
        assert path in refusal(configs.replace(Config(), path, changed))

    def test_no_setting_takes_what_no_flight_or_training_has(self):
        """Of every number of every setting: what float32 does not hold, and what is beside its range."""
        tried = 0
        for path, value, item in configs.leaves(configs.preset("transport")):
            if isinstance(value, (bool, str)):
                continue
            low, high = item.metadata["low"], item.metadata["high"]
            whole = "int" in str(item.type)
            wrong = [low - 1, 2 * high, 10**300, -(10**300)]
            for number in wrong if whole else [*map(float, wrong), 1e-320, -1e-320]:
                changed = (number,) * max(1, len(value)) if isinstance(value, tuple) else number
                said = refusal(configs.replace(configs.preset("transport"), path, changed))
                assert path in said, (path, number)
                assert len(said) < 200, (path, number)
                tried += 1
        assert tried > 800

    @rows(
        ("path", "text"),
        [
            ("plant.rotor_lag", "1e-5"),  # next to none
            ("plant.yaw_per_thrust", "1e-6"),
            ("leader.integral_error_limit", "1e9,1e9,1e9"),  # no limit
            ("scenario.termination_distance", "1e9"),
            ("scenario.rotor_lag_scale", "0.001,1"),
            ("sac.policy_layers", ",".join(["8"] * 100)),
            ("sac.learning_rate_final_ratio", "1e-9"),
            ("reward.termination", "1e8"),
        ],
    )
    def test_what_is_next_to_nothing_or_next_to_endless_is_taken(self, path, text):
        configs.validate(configs.override(configs.preset("transport"), path, text))

    def test_no_tuple_is_endless(self):
        for path in ("sac.policy_layers", "follower.observation_averages", "scenario.team_sizes"):
            assert path in refusal(configs.override(Config(), path, ",".join("2" * 1000)))

    @rows(
        ("changes", "named"),
        [
            ({"scenario.cg_amplitude": (0.0, 0.18)}, "cg_amplitude"),
            ({"plant.object_size": (0.09, 0.1, 0.05)}, "cg_amplitude"),
            ({"scenario.goal_range": 1.5}, "termination_distance"),
            ({"scenario.goal_range": 1.0, "scenario.start_position": 0.5}, "termination_distance"),
            ({"scenario.termination_distance": 1.7}, "termination_distance"),
            ({"plant.drones.0.mount": (-0.2, 0.0, 0.0)}, "plant.drones.0.mount"),
            ({"timing.physics_steps": 3}, "ms"),
            ({"timing.control_period": 0.04}, "ms"),
            ({"sac.num_envs": 2048, "sac.replay_size": 1024}, "replay"),
            ({"sac.batch_size": 2048, "sac.replay_size": 1024}, "replay"),
            ({"sac.num_envs": 100, "sac.replay_size": 1050}, "multiple"),
            ({"sac.num_envs": 128, "sac.replay_size": 256, "sac.n_step": 3}, "replay"),
        ],
    )
    def test_leaves_that_do_not_fit_together(self, changes, named):
        config = Config()
        for path, value in changes.items():
            config = configs.replace(config, path, value)
        assert named in refusal(config)

    @rows(
        ("path", "value"),
        [
            ("scenario.cg_amplitude", (0.17, 0.17)),  # half the object's length: the sweep's widest
            ("timing.physics_steps", 4),  # 5 ms: the slowest attitude loop
            ("scenario.goal_range", 1.44),  # sqrt(3) 1.44 = 2.494 m < d_term
            ("sac.replay_size", 256),  # one batch
        ],
    )
    def test_limits_themselves_are_allowed(self, path, value):
        configs.validate(configs.replace(Config(), path, value))

    def test_config_is_frozen(self):
        with pytest.raises(dataclasses.FrozenInstanceError):
            Config().plant.arm = 0.2


def test_a_record_of_an_older_version_gets_the_defaults() -> None:
    recorded = configs.to_dict(configs.preset("flight"))
    del recorded["autopilot"]["follower_ki_scale"], recorded["scenario"]
    found = configs.from_record(recorded)
    assert (found.autopilot.follower_ki_scale, found.scenario) == (1.0, configs.ScenarioRanges())
    assert found.plant == configs.preset("flight").plant


@rows("changed", [{"nothing": 1}, {"autopilot": 3}, {"plant": {"x": 1}}])
def test_a_record_that_does_not_fit_is_refused(changed: dict) -> None:
    with pytest.raises(InputError, match="configuration"):
        configs.from_record({**configs.to_dict(configs.preset("flight")), **changed})


@rows(
    ("section", "name"),
    [("sac", "worlds"), ("plant", "leader_mass"), ("follower", "base"), ("rigs", "fade"), ("gradient", "damping")],
)
def test_a_record_of_a_version_that_had_other_settings_is_refused(section: str, name: str) -> None:
    recorded = configs.to_dict(Config())
    recorded[section][name] = 1
    for read in (configs.from_dict, configs.from_record):
        with pytest.raises(InputError, match=rf"unknown {name}\b.*; mjxball 0.1.0 is the last version that reads"):
            read(recorded)


@rows("path", sorted(Path(__file__).parents[2].glob("policies/**/*.npz")))
def test_the_card_of_every_shipped_policy(path: Path) -> None:
    metadata = load_file(path).metadata
    config = configs.validate(configs.from_record(metadata["config"]))
    assert (configs.config_hash(metadata["config"]), config.preset) == (metadata["config_hash"], metadata["preset"])
    assert configs.from_record({"plant": metadata["plant"]}).plant == config.plant
