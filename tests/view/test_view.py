"""The viewer: flight files, what is flown on the spot, the page in a real browser, and refusals."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import TRANSPORT, assert_one_line, call, listing
from conftest import opened

from mjxball.config import Plant
from mjxball.errors import InputError
from mjxball.policy import load_file, shipped_policy
from mjxball.view.flight import Flight, check_flight, flight_from, load_flight, save_flight, shapes
from mjxball.view.main import main
from mjxball.view.page import flight_page, page_contents, plant_of
from mjxfly.policy_setup import config_of

SECONDS = 4.0


@pytest.fixture(scope="module")
def flight() -> Flight:
    """The shipped policy on the reference scenario, its first seconds."""
    return flight_from(str(TRANSPORT), {"seconds": SECONDS}, "newton-euler")


@pytest.fixture(scope="module")
def page(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "flight.html"
    path.write_text(flight_page(flight), encoding="utf-8")
    return path


@pytest.fixture(params=[1280, 390], ids=["desktop", "phone"])
def tab(request: pytest.FixtureRequest, browser: Any, page: Path) -> Any:
    """The page, which fetched nothing, made no error and fits in width."""
    result = opened(browser, page, request.param)
    yield result
    result.close()


def test_what_is_flown_is_the_reference(flight: Flight):
    assert len(flight["time"]) == 201
    assert np.linalg.norm(flight["target"][0] - flight["position"][0]) == pytest.approx(np.sqrt(3))
    assert np.linalg.norm(flight["target"][-1] - flight["position"][-1]) < 0.05  # it settles within 2 s
    assert flight.title == "transport-large: CG ±5 cm at 0.31 rad/s, 0.2 kg"


@pytest.mark.parametrize(
    ("name", "title"), [("flight", "flight: CG ±{cg:g} cm at 0.31 rad/s"), ("stand", "stand: ball from {ball:g} cm")]
)
def test_a_policy_for_crazyflies_flies_its_own_plant(name: str, title: str):
    ranges = config_of(load_file(shipped_policy(name)).metadata).scenario
    title = title.format(cg=100 * ranges.cg_amplitude[1], ball=100 * ranges.ball_start)
    shown = flight_from(str(shipped_policy(name)), {"seconds": 1.0}, "newton-euler")
    assert shown.title == f"{title}, 0.0175 kg"
    assert shown.plant.layout == "x"
    assert len(shown["time"]) == 101


def test_a_flight_file_gives_the_flight_back(flight: Flight, tmp_path: Path):
    save_flight(tmp_path / "flight.npz", flight)
    again = flight_from(str(tmp_path / "flight.npz"), {}, "newton-euler")
    assert (again.title, again.plant) == (flight.title, flight.plant)
    np.testing.assert_array_equal(again["time"], flight["time"])
    for name in shapes(flight.plant):
        np.testing.assert_allclose(again[name], flight[name], rtol=1e-6, atol=0)  # float32


def test_a_run_directory_and_a_baseline_are_flown(flight: Flight, tmp_path: Path):
    (tmp_path / "mine").mkdir()
    shutil.copy(TRANSPORT, tmp_path / "mine" / "policy.npz")
    run = flight_from(str(tmp_path / "mine"), {"seconds": SECONDS}, "newton-euler")
    assert run.title.startswith("mine: ")
    np.testing.assert_array_equal(run["position"], flight["position"])
    copy = flight_from("copy", {"seconds": 1.0}, "newton-euler")
    np.testing.assert_array_equal(copy["leader_command"], copy["follower_command"])


def test_a_law_of_ones_own_is_flown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "own_view.py").write_text("from mjxball.control.followers import Copy\nclass Controller(Copy): pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    own, ours = (flight_from(name, {"seconds": 1.0}, "newton-euler") for name in ("own_view:Controller", "copy"))
    assert own.title == ours.title.replace("copy", "Controller")
    np.testing.assert_array_equal(own["position"], ours["position"])


@pytest.mark.parametrize(("name", "place"), [("team3", "on a circle of 5 cm"), ("plate4", "ball from 8 cm")])
def test_teams_are_flown_and_saved(name: str, place: str, tmp_path: Path):
    shown = flight_from("adaptive", {"seconds": 1.0}, "newton-euler", Path(name))
    assert place in shown.title
    drones = shown.plant.count
    assert shown["follower_command"].shape == (51, drones - 1, 3)
    assert shown["cg_offset"].shape == (51, 2)
    save_flight(tmp_path / "flight.npz", shown)
    again = load_flight(tmp_path / "flight.npz")
    assert again.plant == shown.plant
    np.testing.assert_allclose(again["follower_command"], shown["follower_command"], rtol=1e-6)
    drawn = page_contents(shown)["plant"]
    assert [drone["name"] for drone in drawn["drones"]] == ["leader", *(f"follower {k}" for k in range(1, drones))]
    assert drawn["axes"] == (0, 1)
    assert drawn["disc"] == (name == "team3")
    wrong = dataclasses.replace(shown, arrays={**shown.arrays, "contact_force": shown["contact_force"][:, :2]})
    with pytest.raises(InputError, match="contact_force"):
        check_flight(wrong, "it")


def test_rotors_of_a_turned_drone_are_drawn_turned():
    """A quarter turn: the rotor at +x comes to +y."""
    one, other = Plant().drones
    plant = dataclasses.replace(Plant(), drones=(dataclasses.replace(one, yaw=np.pi / 2, arm=0.1), other))
    turned, straight = (drone["rotors"] for drone in plant_of(plant)["drones"])
    np.testing.assert_allclose(turned[0], [0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(straight[0], [0.12, 0.0], atol=1e-12)


def test_the_page_of_a_team(browser: Any, tmp_path: Path):
    """Every drone has a line in each plot of commands, in its own colour, and two arrows; the CG has two numbers."""
    shown = flight_from("adaptive", {"seconds": 1.0}, "newton-euler", Path("team4"))
    path = tmp_path / "team.html"
    path.write_text(flight_page(shown), encoding="utf-8")
    tab = opened(browser, path, 1000)
    tab.evaluate("player.seek(0.5)")
    x, y = 100 * shown["cg_offset"][25]
    assert tab.inner_text(".now-cg").replace("−", "-") == f"{x:.1f}, {y:.1f} cm"
    pitch = tab.locator(".plot", has_text="Commanded pitch").locator(".legend > span").all_inner_texts()
    names = [re.sub(r" [−\d.]+$", "", text) for text in pitch]
    assert names == ["leader", "follower 1", "follower 2", "follower 3"]
    values = [float(text.split()[-1].replace("−", "-")) for text in pitch]
    commands = [shown["leader_command"][25, 1], *shown["follower_command"][25, :, 1]]
    np.testing.assert_allclose(values, np.degrees(commands), rtol=6e-3)
    colours = tab.evaluate("[0, 1, 2, 3].map((drone) => player.panes[0].flight.colour(drone))")
    assert len(set(colours)) == 4
    arrows = tab.evaluate(
        """() => {
            let count = 0;
            const [{ scene }] = player.panes, arrow = scene.arrow;
            scene.arrow = () => { count += 1; };
            player.seek(0.7);
            scene.arrow = arrow;
            return count;
        }"""
    )
    assert arrows == 9
    tab.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arrays: arrays.pop("position"), "position is missing"),
        (lambda arrays: arrays.update(euler=arrays["euler"][:-1]), "euler is missing or not of shape"),
        (lambda arrays: arrays.update(time=arrays["time"][::-1]), "time must increase"),
        (lambda arrays: arrays["time"].__setitem__(4, arrays["time"][3]), "time must increase"),
        (lambda arrays: arrays["target"].__setitem__((3, 1), np.nan), "target holds a value that is not finite"),
        (lambda arrays: arrays.update(time=np.zeros(1)), "at least two rows"),
    ],
)
def test_an_unsound_flight_file_is_refused(change: Any, message: str, flight: Flight, tmp_path: Path):
    arrays = {name: array.copy() for name, array in flight.arrays.items()}
    time = arrays["time"]
    change(arrays)
    arrays.setdefault("time", time)
    save_flight(tmp_path / "bad.npz", dataclasses.replace(flight, arrays=arrays))
    with pytest.raises(InputError, match=message):
        load_flight(tmp_path / "bad.npz")


def test_damaged_files_are_refused(flight: Flight, tmp_path: Path):
    save_flight(tmp_path / "whole.npz", flight)
    whole = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    np.savez(tmp_path / "pickle.npz", about=np.array({"format": 1}, object))
    np.savez(tmp_path / "other.npz", about=np.array('{"format": "another"}'))
    for name, message in (("half", "damaged"), ("pickle", "damaged"), ("other", "not a flight")):
        with pytest.raises(InputError, match=message):
            load_flight(tmp_path / f"{name}.npz")


def test_text_in_a_title_stays_text(flight: Flight, browser: Any, tmp_path: Path):
    evil = "</script><script>document.title='gone'</script>&"
    path = tmp_path / "evil.html"
    path.write_text(flight_page(dataclasses.replace(flight, title=evil)), encoding="utf-8")
    tab = opened(browser, path, 800)
    assert tab.title() == tab.inner_text("h1") == evil
    tab.close()


def test_it_shows_the_numbers_of_the_moment(tab: Any, flight: Flight):
    tab.evaluate("player.seek(1.5)")
    row = 75
    assert tab.inner_text("#time") == "1.50 s"
    error = flight["target"][row] - flight["position"][row]
    assert tab.inner_text(".now-error") == f"{np.linalg.norm(error):.3f} m"
    assert tab.inner_text(".now-tilt") == f"{np.degrees(np.hypot(*flight['euler'][row, :2])):.1f}°"
    assert tab.inner_text(".now-cg") == f"{100 * flight['cg_offset'][row]:.1f} cm"
    shown = [
        float(text.replace("−", "-")) for text in tab.locator(".plot").first.locator(".legend b").all_inner_texts()
    ]
    np.testing.assert_allclose(shown, error, rtol=6e-3)  # three digits
    titles = [re.sub(r" \[.*", "", text) for text in tab.locator(".plot h3").all_inner_texts()]
    assert titles[:2] == ["Error to the goal", "Error near the goal, up to ±20 mm"]
    assert tab.locator(".who span").all_inner_texts() == [" leader", " follower"]
    assert {"Thrust", "Contact force on the object", "CG from the centre"} <= set(titles)


def test_an_arrow_is_the_force(tab: Any, flight: Flight):
    """The leader's thrust arrow in pixels is the projection of R e3 times its newtons."""
    drawn = tab.evaluate(
        """() => {
            const found = [], [{ scene }] = player.panes, arrow = scene.arrow;
            scene.arrow = (from, along, colour) => { found.push([from, along, colour]); };
            player.seek(0.7);
            scene.arrow = arrow;
            return [found, scene.world.reach];
        }"""
    )
    (from_place, along, _), scale = drawn[0][0], drawn[1]["thrust"]
    w, x, y, z = flight["quaternion"][35]
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    axis = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    thrust = flight["rotor_force"].sum(axis=-1)
    np.testing.assert_allclose(along, scale * thrust[35, 0] * up, atol=1e-5)  # float32
    np.testing.assert_allclose(from_place, flight["position"][35] + 0.17 * axis, atol=1e-5)
    assert scale == pytest.approx(0.3 / thrust.max(), rel=1e-5)
    assert len(drawn[0]) == 5  # thrust and contact of each drone, the weight


def test_controls(tab: Any):
    tab.select_option("#speed", "2")
    tab.click("#play")
    tab.wait_for_function("player.now > 0.5")
    tab.click("#play")
    stopped = tab.evaluate("player.now")
    assert not tab.evaluate("player.playing")
    tab.evaluate("document.getElementById('seek').value = 2; player.seekControl.oninput()")
    assert tab.inner_text("#time") == "2.00 s"
    assert stopped != 2.0
    plot = tab.locator(".plot canvas").first
    box = plot.bounding_box()
    left, right = tab.evaluate("[LEFT, RIGHT]")
    plot.click(position={"x": left + 0.25 * (box["width"] - left - right), "y": 40})
    assert tab.evaluate("player.now") == pytest.approx(0.25 * SECONDS, abs=SECONDS / 100)  # a pixel or two
    before = tab.evaluate("player.camera.azimuth")
    scene = tab.locator(".view canvas").bounding_box()
    tab.mouse.move(scene["x"] + 150, scene["y"] + 150)
    tab.mouse.down()
    tab.mouse.move(scene["x"] + 200, scene["y"] + 150)
    tab.mouse.up()
    assert tab.evaluate("player.camera.azimuth") != before
    tab.select_option("#width", "1")
    assert tab.evaluate("player.panes[0].plots[0].to - player.panes[0].plots[0].from") == pytest.approx(1.0)


def test_it_plays_to_the_end_and_stops(browser: Any, page: Path):
    tab = opened(browser, page, 1000)
    tab.evaluate(f"player.seek({SECONDS} - 0.1)")
    tab.click("#play")
    tab.wait_for_function("!player.playing")
    assert tab.inner_text("#time") == f"{SECONDS:.2f} s"
    tab.close()


def test_what_nobody_measured_is_not_shown(flight: Flight, browser: Any, tmp_path: Path):
    """A flight log has no contact forces: neither they nor the weight, which has their scale, can be drawn."""
    arrays = {**flight.arrays, "contact_force": np.zeros_like(flight["contact_force"])}
    path = tmp_path / "log.html"
    path.write_text(flight_page(dataclasses.replace(flight, arrays=arrays)), encoding="utf-8")
    tab = opened(browser, path, 1000)
    assert not tab.is_visible(".now-cg")
    assert [box.get_attribute("id") for box in tab.locator("#shown input").all()] == [
        "follow",
        "show-thrust",
        "show-path",
    ]
    assert not any(title.startswith(("CG", "Contact")) for title in tab.locator(".plot h3").all_inner_texts())
    tab.close()


@pytest.mark.parametrize(("name", "plant", "units"), [("balance-sac", None, (48,)), ("universal", "team3", (2, 96))])
def test_what_a_recurrent_network_remembers_is_shown_if_asked(
    name: str, plant: str | None, units: tuple[int, ...], browser: Any, tmp_path: Path
):
    """Its own replay beside the state that the viewer holds, which is drawn a row of colour each."""
    source, rig = str(shipped_policy(name)), None if plant is None else Path(plant)
    shown = flight_from(source, {"seconds": 2.0}, "newton-euler", rig, hidden=True)
    assert shown["hidden"].shape == (101, *units)
    assert 0.1 < np.abs(shown["hidden"]).max() <= 1
    path = tmp_path / "kept.npz"
    save_flight(path, shown)
    np.testing.assert_allclose(flight_from(str(path), {}, "", hidden=True)["hidden"], shown["hidden"], atol=1e-6)
    assert "hidden" not in flight_from(str(path), {}, "").arrays
    page = tmp_path / "page.html"
    page.write_text(flight_page(shown), encoding="utf-8")
    tab = opened(browser, page, 1280)
    assert "What the follower’s network remembers" in tab.text_content("#plots")
    tab.locator(".plot canvas").last.scroll_into_view_if_needed()
    tab.evaluate("player.draw()")
    # The uppermost pixels at the end are the last unit: red above 0, blue below.
    red, blue = tab.evaluate(
        "(() => { const plot = [...document.querySelectorAll('.plot canvas')].at(-1), ratio = devicePixelRatio;"
        "const dot = plot.getContext('2d').getImageData(plot.width - 12 * ratio, 7 * ratio, 1, 1).data;"
        "return [dot[0], dot[2]]; })()"
    )
    last = shown["hidden"][-1].ravel()[-1]
    assert np.sign(red - blue) == np.sign(last) or abs(last) < 0.02
    tab.close()


def test_who_has_no_recurrent_network_shows_none(flight: Flight, tmp_path: Path):
    path = tmp_path / "flight.npz"
    save_flight(path, flight)
    for source in (str(TRANSPORT), "copy", str(path)):
        with pytest.raises(InputError, match="holds no state of a recurrent network"):
            flight_from(source, {"seconds": 1.0}, "newton-euler", hidden=True)


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture):
    page, record = tmp_path / "page.html", tmp_path / "flight.npz"
    given = ["copy", "--seconds", 1, "--omega", 2, "--out", page, "--save", record]
    assert call(main, given) == 0
    assert capsys.readouterr().out == f"the flight is {record}\nthe page is {page}\n"
    assert load_flight(record).title == "copy: CG ±5 cm at 2 rad/s, 0.2 kg"
    shown = flight_from("copy", {"omega": 2, "seconds": 1}, "newton-euler")
    assert page.read_text(encoding="utf-8") == flight_page(shown)
    before = listing(tmp_path)
    assert call(main, given) == 2
    assert "exists" in capsys.readouterr().err
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nobody"], "nobody is no flight"),
        (["nowhere:Law"], "there is no module nowhere"),
        (["log.jsonl"], "mjxfly.view plays flight logs"),
        (["empty"], "has no policy.npz"),
        (["none.npz"], "none.npz does not exist"),
        (["copy", "--out", "page.txt"], "must end in .html"),
        (["copy", "--amplitude", "3"], "leaves the object"),
    ],
)
def test_refusals(arguments: list[str], message: str, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "log.jsonl").write_text('{"t": 0.0, "kind": "tick"}\n')
    before = listing(tmp_path)
    assert call(main, [arguments[0], *(arguments[1:] or ["--out", "page.html"])]) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert message in errors
    assert listing(tmp_path) == before


def test_rotors_are_where_the_layout_puts_them(flight: Flight, browser: Any, tmp_path: Path):
    """On the axes of a plus layout, between them on a Crazyflie, which has layout x."""
    shown = flight_from(str(shipped_policy("flight")), {"seconds": 0.5}, "newton-euler")
    side = shown.plant.arm / np.sqrt(2)
    expected = [[-side, -side], [-side, side], [side, -side], [side, side]]
    np.testing.assert_allclose(sorted(page_contents(shown)["plant"]["drones"][1]["rotors"]), expected)
    arm = flight.plant.arm
    assert sorted(page_contents(flight)["plant"]["drones"][0]["rotors"]) == [[-arm, 0], [0, -arm], [0, arm], [arm, 0]]
    path = tmp_path / "flight.html"
    path.write_text(flight_page(shown), encoding="utf-8")
    tab = opened(browser, path, 1000)
    discs = tab.evaluate(
        """() => {
            const [{ scene }] = player.panes, found = [], face = scene.face;
            scene.face = (points, ...rest) => { if (points.length === 25) found.push(points.slice(1)); };
            scene.team(0);
            scene.face = face;
            return found;
        }"""
    )
    tab.close()
    centres = np.mean(np.array(discs), axis=1)[:4] - shown["position"][0] - shown.plant.pair[0].mount
    np.testing.assert_allclose(np.abs(centres[:, :2]), side, atol=2e-3)  # level but for the start's tilt


def test_a_flight_knows_its_plant(flight: Flight):
    assert flight.plant == Plant()


def test_facts_of_a_simulated_flight() -> None:
    flight = flight_from(str(TRANSPORT), {"seconds": 25.0}, "newton-euler")
    facts = dict(flight.facts)
    error = np.linalg.norm(flight["target"] - flight["position"], axis=-1)
    assert facts["largest error from 20 s on"] == f"{1000 * error[flight['time'] >= 20].max():.1f} mm"
    settled = float(facts["settles"].removesuffix(" s"))
    after = error[flight["time"] > settled + 0.01]
    assert after.max() <= 0.02 * error[0] < error[flight["time"] <= settled + 0.01][-2:].max() + 1e-3
    assert [name for name, _ in flight_from(str(TRANSPORT), {"seconds": 5.0}, "newton-euler").facts] == [
        "settles",
        "rotor at its limit",
    ]
    assert dict(flight_from("random", {"seconds": 5.0}, "newton-euler").facts).get("settles") in (None, "never")
