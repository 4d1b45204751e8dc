"""The viewer in a real browser: gestures, keys, ranges, the theme, two flights, a long one; who cannot draw."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import TRANSPORT
from conftest import opened
from tables import weekly

from mjxball.view.flight import Flight, flight_from, save_flight, shapes
from mjxball.view.page import flight_page

SECONDS = 4.0
# Where the rig is seen [pixels of the page].
RIG = """() => { const [{ scene, flight }] = player.panes, box = scene.canvas.getBoundingClientRect();
    const [x, y] = scene.lens.project(flight.at('position', flight.rowAt(player.now)));
    return [box.left + x, box.top + y]; }"""
LIGHTNESS = """() => [...document.querySelectorAll('.view canvas, .plot canvas')].slice(0, 1).map((canvas) =>
    Math.max(...canvas.getContext('2d').getImageData(3, 3, 1, 1).data.slice(0, 3)))[0]"""


def written(place: Path, *flights: Flight) -> Path:
    path = place / "flight.html"
    path.write_text(flight_page(*flights), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def flight() -> Flight:
    return flight_from(str(TRANSPORT), {"seconds": SECONDS}, "newton-euler")


@pytest.fixture(scope="module")
def page(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("page"), flight)


@pytest.fixture(params=[1300, 400], ids=["desktop", "phone"])
def tab(request: pytest.FixtureRequest, browser: Any, page: Path) -> Iterator[Any]:
    result = opened(browser, page, request.param)
    yield result
    result.close()


def drag(tab: Any, begin: tuple[float, float], by: tuple[float, float], button: str = "left") -> None:
    tab.mouse.move(*begin)
    tab.mouse.down(button=button)
    tab.mouse.move(begin[0] + by[0], begin[1] + by[1])
    tab.mouse.up(button=button)


def test_the_right_button_and_shift_move_what_is_seen(tab: Any) -> None:
    """What is at the target's depth goes along with the pointer; a plain drag moves nothing."""
    tab.evaluate("player.seek(2); player.follow(true)")
    before = np.array(tab.evaluate(RIG))
    drag(tab, tuple(before), (40, 25), "right")
    np.testing.assert_allclose(tab.evaluate(RIG), np.add(before, (40, 25)), atol=0.01)
    tab.keyboard.down("Shift")
    drag(tab, tuple(before), (-60, 5))
    tab.keyboard.up("Shift")
    np.testing.assert_allclose(tab.evaluate(RIG), np.add(before, (-20, 30)), atol=0.01)
    pan = tab.evaluate("player.camera.pan")
    drag(tab, tuple(before), (30, 0))
    assert tab.evaluate("player.camera.pan") == pan
    tab.keyboard.press("r")
    np.testing.assert_allclose(tab.evaluate(RIG), before, atol=0.01)


def test_the_wheel_zooms_at_the_pointer(tab: Any) -> None:
    """What is under the pointer stays; what is elsewhere goes away from it."""
    tab.evaluate("player.seek(2); player.follow(true)")
    drag(tab, tuple(tab.evaluate(RIG)), (70, 40), "right")
    rig, distance = np.array(tab.evaluate(RIG)), tab.evaluate("player.camera.distance")
    tab.mouse.move(*rig)
    tab.mouse.wheel(0, -400)
    tab.wait_for_function("distance => player.camera.distance < 0.8 * distance", arg=distance)
    np.testing.assert_allclose(tab.evaluate(RIG), rig, atol=1.0)  # the pointer's pixels are whole ones
    tab.mouse.move(*(rig - (50, 0)))
    tab.mouse.wheel(0, -200)
    tab.wait_for_function("distance => player.camera.distance < 0.6 * distance", arg=distance)
    assert tab.evaluate(RIG)[0] > rig[0] + 5


def test_two_fingers_zoom_and_move(browser: Any, page: Path) -> None:
    tab = browser.new_page(viewport={"width": 400, "height": 800}, has_touch=True)
    tab.goto(page.as_uri())
    tab.evaluate("player.seek(2); player.follow(true)")
    x, y = tab.evaluate(RIG)
    distance, fingers = tab.evaluate("player.camera.distance"), tab.context.new_cdp_session(tab)

    def touch(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": left, "y": top, "id": number} for number, (left, top) in enumerate(places)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", (x - 30, y), (x + 30, y))
    touch("touchMove", (x - 40, y + 20), (x + 80, y + 20))
    touch("touchEnd")
    tab.wait_for_function("distance => player.camera.distance < 0.55 * distance", arg=distance)
    assert tab.evaluate("player.camera.distance") == pytest.approx(distance * 60 / 120, rel=0.01)
    np.testing.assert_allclose(tab.evaluate(RIG), [x + 20, y + 20], atol=2.0)  # the middle of the fingers
    tab.close()


def test_the_rig_is_followed(tab: Any) -> None:
    middle = "() => { const box = player.panes[0].scene.canvas.getBoundingClientRect();"
    middle = tab.evaluate(middle + " return [box.left + box.width / 2, box.top + box.height / 2]; }")
    tab.evaluate("player.seek(0)")
    assert np.hypot(*(np.array(tab.evaluate(RIG)) - middle)) > 20
    tab.click("#follow")
    for time in (0, 1, 3):
        tab.evaluate(f"player.seek({time})")
        np.testing.assert_allclose(tab.evaluate(RIG), middle, atol=0.5)  # whole pixels
    tab.keyboard.press("f")  # the picture stays where it is, and the rig flies through it
    assert not tab.is_checked("#follow")
    np.testing.assert_allclose(tab.evaluate(RIG), middle, atol=0.5)  # whole pixels
    tab.evaluate("player.seek(0)")
    assert np.hypot(*(np.array(tab.evaluate(RIG)) - middle)) > 20


@pytest.mark.parametrize(
    "clicked", ["#play", "#speed", *weekly("#seek", "#show-path", "#follow", ".pin", ".view canvas", "h1")]
)
def test_keys_work_whatever_was_clicked(clicked: str, tab: Any) -> None:
    tab.locator(clicked).first.click()
    if clicked == "#play":
        tab.locator(clicked).first.click()
    if clicked == "#speed":
        tab.keyboard.press("Escape")  # its list
    tab.evaluate("player.seek(1)")
    state = "[...document.querySelectorAll('#shown input')].map((box) => box.checked)"
    before, speed = tab.evaluate(state), tab.input_value("#speed")
    for _ in range(7):
        tab.keyboard.press("ArrowRight")
    assert tab.evaluate("player.now") == pytest.approx(1.7, abs=1e-9)
    assert tab.inner_text("#time") == "1.70 s"
    tab.keyboard.press("Shift+ArrowLeft")
    tab.keyboard.press("ArrowLeft")
    assert tab.evaluate("player.now") == pytest.approx(0.6, abs=1e-9)
    tab.keyboard.press("Space")
    assert tab.evaluate("player.playing")
    tab.keyboard.press("Space")
    assert not tab.evaluate("player.playing")
    tab.keyboard.press("End")
    assert tab.evaluate("player.now") == pytest.approx(SECONDS)
    assert (tab.evaluate(state), tab.input_value("#speed")) == (before, speed)


def test_who_writes_or_comes_by_tab_keeps_the_keys(tab: Any) -> None:
    tab.evaluate("document.querySelector('h1').append(document.createElement('input')); player.seek(1)")
    tab.click("h1 input")
    tab.keyboard.type("d r?")
    tab.keyboard.press("ArrowLeft")
    assert tab.input_value("h1 input") == "d r?"
    assert tab.evaluate("[player.now, player.playing, document.getElementById('keys').open]") == [1, False, False]
    while tab.evaluate("document.activeElement.id") != "speed":
        tab.keyboard.press("Tab")
    tab.keyboard.press("ArrowDown")
    assert tab.input_value("#speed") == "2"
    tab.keyboard.press("ArrowRight")
    assert tab.evaluate("player.now") == 1


def test_keys_are_listed(tab: Any) -> None:
    tab.locator(".view canvas").click()
    tab.keyboard.press("?")
    assert tab.locator("#keys").is_visible()
    assert tab.locator("#keys dt").all_inner_texts() == tab.evaluate("Object.values(KEYS).map(([name]) => name)")
    assert tab.locator("#keys dd").count() == tab.evaluate("Object.keys(KEYS).length") > 8
    now = tab.evaluate("player.now")
    tab.keyboard.press("ArrowRight")
    assert tab.evaluate("player.now") == now
    tab.keyboard.press("?")
    assert not tab.locator("#keys").is_visible()


def test_the_y_range_is_of_what_is_seen_until_it_is_pinned(tab: Any, flight: Flight) -> None:
    def ranges() -> list[float]:
        return tab.evaluate("(() => { const plot = player.panes[0].plots[3]; return [plot.low, plot.high]; })()")

    def expected(begin: float, end: float) -> list[float]:
        rows = (flight["time"] >= begin - 1e-6) & (flight["time"] <= end + 1e-6)
        seen = np.degrees(flight["euler"][rows])
        margin = 0.06 * (seen.max() - seen.min())
        return [seen.min() - margin, seen.max() + margin]

    assert tab.locator(".plot h3").nth(3).inner_text().startswith("Attitude")
    np.testing.assert_allclose(ranges(), expected(0, SECONDS), rtol=1e-5)
    tab.select_option("#width", "1")
    tab.evaluate("player.seek(0.7)")
    early = expected(0.2, 1.2)
    np.testing.assert_allclose(ranges(), early, rtol=1e-5)
    pin = tab.locator(".plot").nth(3).locator(".pin")
    pin.click()
    tab.evaluate("player.seek(3)")
    np.testing.assert_allclose(ranges(), early, rtol=1e-5)
    pin.click()
    late = expected(2.5, 3.5)
    np.testing.assert_allclose(ranges(), late, rtol=1e-4)
    assert late[1] - late[0] < 0.3 * (early[1] - early[0])


def test_dark_as_the_system_is_until_it_is_switched(browser: Any, page: Path) -> None:
    tab = browser.new_page(viewport={"width": 400, "height": 800}, color_scheme="dark")
    tab.goto(page.as_uri())
    paper = "getComputedStyle(document.body).backgroundColor"
    dark, drawn, line = tab.evaluate(paper), tab.evaluate(LIGHTNESS), tab.evaluate("colour('ink')")
    assert drawn < 60
    for switch in (lambda: tab.keyboard.press("d"), lambda: tab.click("#theme")):
        switch()
        assert tab.evaluate(LIGHTNESS) > 200
        assert tab.evaluate(paper) == "rgb(255, 255, 255)" != dark
        assert tab.evaluate("colour('ink')") != line
        switch()
        assert tab.evaluate(LIGHTNESS) == drawn
        assert tab.evaluate(paper) == dark
    tab.emulate_media(color_scheme="light")
    tab.wait_for_function(f"({LIGHTNESS})() > 200")
    tab.close()


def test_numbers_are_for_people(tab: Any) -> None:
    """No exponents, no negative zeros; ticks have room beside their plot, those of a line of zeros as well."""
    assert tab.evaluate("[fixed(7.51e-9, 0.01), fixed(-1e-9, 0.1), fixed(-1.26, 0.1)]") == ["0.00", "0.0", "−1.3"]
    assert tab.evaluate("[short(0.2084), short(1e-4), short(20)]") == ["0.208", "0.0001", "20"]
    assert tab.evaluate("ticks(1000, 1002, 2).map(([, text]) => text)") == ["1000", "1001", "1002"]
    widest = """([low, high]) => {
        const c = document.createElement('canvas').getContext('2d');
        c.font = '11px system-ui, sans-serif';
        const plot = { least: low, most: high, peers: [] };
        plot.peers.push(plot);
        Plot.prototype.range.call(plot);
        return Math.max(...ticks(plot.low, plot.high, 3).map(([, text]) => c.measureText(text).width)) - LEFT;
    }"""
    for low, high in ((0.0, 0.0), (-1e-7, 1e-7), (-0.3, 0.2), (-1e4, 1e4)):
        assert tab.evaluate(widest, [low, high]) < -6, (low, high)


def test_the_goal_is_behind_the_load(browser: Any, flight: Flight, tmp_path: Path) -> None:
    """Where the object is at its goal: thin lines alone, and every face of the team is painted after them."""
    there = dataclasses.replace(flight, arrays={**flight.arrays, "target": flight["position"]})
    tab = opened(browser, written(tmp_path, there), 1000)
    order = tab.evaluate(
        """() => { const [{ scene }] = player.panes, { paintOne } = scene, found = [];
            palette.set('goal', 'rgb(1, 2, 3)');
            scene.paintOne = function (part) { found.push([part.line === colour('goal'), Boolean(part.fill),
                part.name === 'goal', part.width]); };
            scene.draw(100);
            scene.paintOne = paintOne;
            return found; }"""
    )
    goals = [number for number, (goal, *_) in enumerate(order) if goal]
    faces = [number for number, (_, face, *_) in enumerate(order) if face]
    assert len(goals) == 6
    assert max(goals) < min(faces)
    assert not any(filled for _, _, filled, _ in order)
    assert max(order[number][3] for number in goals) <= 1.5
    tab.close()


def test_the_scale_of_arrows_is_that_of_the_scene(tab: Any) -> None:
    """A round force, as long as an arrow of it would be across the view; contact and weight have one scale."""
    tab.evaluate("player.seek(2); player.follow(true)")
    bars, reach, focal, distance = tab.evaluate(
        "(() => { const { scene } = player.panes[0]; return [scene.bars(100), scene.world.reach, scene.lens.focal,"
        "player.camera.distance]; })()"
    )
    assert [bar["text"].split(" ", 1)[1] for bar in bars] == ["N thrust", "N contact, weight", "cm"]
    for bar, metres in zip(bars, (reach["thrust"], reach["contact"], 0.01), strict=True):
        assert bar["pixels"] == pytest.approx(bar["value"] * metres * focal / distance)
        assert bar["value"] / 10 ** math.floor(math.log10(bar["value"]) + 1e-9) == pytest.approx(
            min((1, 2, 5), key=lambda k: abs(bar["value"] / 10 ** math.floor(math.log10(bar["value"]) + 1e-9) - k))
        )
        assert 25 < bar["pixels"] <= 81
    arrow = tab.evaluate(
        "(() => { const { scene, flight } = player.panes[0], from = flight.at('position', 100), found = [];"
        "scene.strokeArrow = (x, y, u, v) => found.push(Math.hypot(u - x, v - y));"
        "scene.arrow(from, times(scene.world.reach.contact, scene.lens.right), 'contact'); return found[0]; })()"
    )
    assert arrow == pytest.approx(bars[1]["pixels"] / bars[1]["value"])
    tab.click("#show-contact")
    tab.click("#show-weight")
    texts = tab.evaluate("player.panes[0].scene.bars(100).map((bar) => bar.text)")
    assert [text.split(" ", 1)[1] for text in texts] == ["N thrust", "cm"]


@pytest.mark.parametrize("width", [1300, 400])
def test_two_flights_have_one_clock(width: int, browser: Any, flight: Flight, tmp_path: Path) -> None:
    other = flight_from("adaptive", {"seconds": 2.0}, "newton-euler", Path("team3"))
    tab = opened(browser, written(tmp_path, flight, other), width)
    first, second = (view.bounding_box() for view in tab.locator(".view").all())
    if width > 900:
        assert first["y"] == second["y"]
        assert first["x"] + first["width"] < second["x"]
    else:
        assert first["x"] == second["x"]
        assert first["y"] + first["height"] < second["y"]
    assert tab.locator("#play").count() == tab.locator("#seek").count() == 1
    assert tab.locator(".view h2").all_inner_texts() == [flight.title, other.title]
    for time, rows in ((1.0, (50, 50)), (3.0, (150, 100))):  # the shorter one stays where it ended
        tab.evaluate(f"player.seek({time})")
        told = [float(text.split()[0]) for text in tab.locator(".now-error").all_inner_texts()]
        errors = [
            np.linalg.norm(one["target"][k] - one["position"][k]) for one, k in zip((flight, other), rows, strict=True)
        ]
        np.testing.assert_allclose(told, errors, atol=6e-4)
    kinds = tab.evaluate(
        "player.panes.map(({ plots }) => plots.map((plot) => [plot.from, plot.to, plot.low, plot.high]))"
    )
    assert kinds[0] == kinds[1]
    assert kinds[0][0][:2] == [0, SECONDS]
    for scene in tab.evaluate("player.panes.map(({ scene }) => [scene.camera === player.camera, scene.world.reach])"):
        assert scene[0]
        assert scene[1] == tab.evaluate("player.panes[0].scene.world.reach")
    titles = tab.locator(".plot h3").all_inner_texts()
    assert titles[0::2] == titles[1::2]
    tab.locator(".pin").first.click()
    assert tab.locator(".pin[aria-pressed=true]").count() == 2
    tab.close()


def test_half_an_hour_is_stored_whole_and_drawn_thin(browser: Any, flight: Flight, tmp_path: Path) -> None:
    """A line has two points a pixel at most and keeps a peak of one row; the path has 2000 points at most."""
    rows, peak = 90_001, 61_234
    there = np.arange(rows) % len(flight["time"])
    arrays: dict[str, Any] = {name: flight[name][there].astype(float) for name in shapes(flight.plant)}
    arrays["time"] = 0.02 * np.arange(rows)
    arrays["euler"][peak, 2] = 0.9
    tab = opened(browser, written(tmp_path, dataclasses.replace(flight, arrays=arrays)), 1300)
    path, stored, points, highest = tab.evaluate(
        """() => { const [{ flight, plots }] = player.panes, plot = plots[3], found = [];
            const context = { beginPath() {}, stroke() {}, lineTo: (x, y) => found.push([x, y]) };
            plot.trace(context, plot.series[2].value, (time) => 400 * time / flight.last, (v) => v, 1);
            return [flight.trail().length, flight.rows, found.length, Math.max(...found.map(([, v]) => v))];
        }"""
    )
    assert stored == rows
    assert path <= 2001
    assert points <= 2 * 401
    assert highest == pytest.approx(np.degrees(0.9), rel=1e-6)
    tab.evaluate(f"player.seek({0.02 * peak})")
    assert tab.evaluate("player.panes[0].flight.rowAt(player.now)") == peak  # float32 times are 0.1 ms apart there
    tab.close()


def test_no_webgl_is_needed(browser: Any, page: Path) -> None:
    tab = browser.new_page()
    errors: list[str] = []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.add_init_script(
        "const own = HTMLCanvasElement.prototype.getContext; HTMLCanvasElement.prototype.getContext ="
        "function (kind, ...rest) { return kind === '2d' ? own.call(this, kind, ...rest) : null; };"
    )
    tab.goto(page.as_uri())
    assert tab.evaluate("player.panes[0].plots.length") > 5
    assert not errors
    tab.close()


def test_a_browser_that_cannot_draw_is_told(browser: Any, page: Path) -> None:
    tab = browser.new_page()
    errors: list[str] = []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    tab.goto(page.as_uri())
    assert tab.inner_text("main").startswith("This browser cannot draw")
    assert not errors
    tab.close()


def test_marks_survive_in_a_flight_file(flight: Flight, tmp_path: Path) -> None:
    from mjxball.errors import InputError
    from mjxball.view.flight import Mark, load_flight

    marked = dataclasses.replace(flight, marks=(Mark(1.0, "phase", "fly", "good"), Mark(2.0, "end", "over", "bad")))
    save_flight(tmp_path / "flight.npz", marked)
    assert load_flight(tmp_path / "flight.npz").marks == marked.marks
    for number, wrong in enumerate(
        (Mark(math.nan, "end", "", "bad"), Mark(1.0, "party", "", ""), Mark(1.0, "end", "", "<"), "ab")
    ):
        path = tmp_path / f"{number}.npz"
        save_flight(path, dataclasses.replace(flight, marks=(wrong,)))
        with pytest.raises(InputError, match="is not a flight"):
            load_flight(path)
