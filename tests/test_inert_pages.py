"""Names, metadata and logs are text in every page that is made of them: no element, no script, no placeholder."""

from __future__ import annotations

import dataclasses
import json
import threading
from pathlib import Path
from typing import Any

import pytest
from conftest import opened
from fly_policies import untrained
from fly_virtual import VirtualTwin, log_header

from mjxball.baselines import make_baseline
from mjxball.config import preset
from mjxball.evaluate import report as report_page
from mjxball.evaluate.report import write_report
from mjxball.evaluate.results import fly_scenarios
from mjxball.policy import Policy, load_file, shipped_policy
from mjxball.sim.scenario import Scenario
from mjxball.view.page import flight_page, page_contents
from mjxfly.flight_log import Journal
from mjxfly.limits import FlightSettings
from mjxfly.supervisor import FlightState
from mjxfly.twin.physics import make_pair
from mjxfly.view.live import LiveView, Server
from mjxfly.view.live_log import LiveLog
from mjxfly.view.recorded import read_log

# As a file's name, which holds no slash; placeholders are those of our own templates, dollars begin a formula.
NAME = "<script>document.title='gone'<img src=x onerror=document.title='gone'>{{script}}{{data}} $\\frac{$ &amp;"
TEXT = f"{NAME}</script><script>document.title='gone'</script></pre></style>-->"


def elements(tab: Any) -> dict[str, int]:
    """How many of each kind of element the page has that a text must not add."""
    return {kind: tab.locator(kind).count() for kind in ("script", "img", "style", "iframe", "object")}


@pytest.mark.slow
def test_a_report_of_a_follower_with_a_hostile_name(browser: Any, tmp_path: Path, monkeypatch: Any) -> None:
    """Also in its metadata, in the command, in titles of scenarios, and in the figures."""
    monkeypatch.setattr(report_page, "film", lambda *_: (None, TEXT))
    config, pages = preset("paper"), {}
    scenarios = [Scenario(omega=omega, seconds=24.0) for omega in (0.31, 1.0)]
    flown = fly_scenarios(config, [make_baseline("copy", config)], scenarios, "newton-euler")
    for label, text in (("plain", "plain"), ("hostile", TEXT)):
        monkeypatch.setattr(report_page, "scenario_title", lambda _, text=text: text)
        results, contents = (
            [dataclasses.replace(one, follower=text) for one in flown],
            load_file(shipped_policy("paper")),
        )
        policy = Policy(dataclasses.replace(contents, metadata={**contents.metadata, "preset": text, text: text}), text)
        write_report(tmp_path / label, config.plant, results, [policy], f"eval.py {text}", {text: text})
        tab = pages[label] = opened(browser, tmp_path / label / "report.html", 1280)
        assert tab.title() == "Flights of followers"
    plain, hostile = pages["plain"], pages["hostile"]
    assert elements(plain) == elements(hostile)
    assert hostile.inner_text("#table tbody tr:nth-child(1) td:nth-child(2)") == TEXT
    assert hostile.inner_text("#table tbody tr:nth-child(2) td:nth-child(1)") == TEXT
    assert hostile.inner_text("details summary >> nth=0") == TEXT
    assert json.dumps(TEXT)[1:-1] in hostile.locator("details pre").last.text_content()
    assert hostile.locator("svg text", has_text=TEXT).count() == plain.locator("svg text", has_text="plain").count() > 0
    hostile.select_option("#follower", TEXT)  # the page's own script still runs
    hostile.select_option("#scenario", TEXT)
    assert hostile.locator("#table tbody tr:visible").count() == len(flown)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a second of flight, in whose texts somebody has written."""
    path, contents = tmp_path_factory.mktemp("log") / f"{NAME}.jsonl", untrained("flight")
    with Journal(path, **log_header(contents, TEXT)) as notes:
        settings = FlightSettings(seconds=1.0, goal=(0.1, 0.0, 0.4))
        world = VirtualTwin(settings, contents=contents, physics=make_pair(contents.metadata), log=notes)
        world.fly_until(FlightState.DONE)
        notes.note("refused", text=TEXT)
    return path


def test_a_flight_log_with_hostile_texts_in_the_viewer(browser: Any, log: Path, tmp_path: Path) -> None:
    """And a recorded flight whose title is one."""
    shown = read_log(log)
    for flight in (shown, dataclasses.replace(shown, title=TEXT), dataclasses.replace(shown, title=NAME)):
        (tmp_path / "page.html").write_text(flight_page(flight), encoding="utf-8")
        tab = opened(browser, tmp_path / "page.html", 1000)
        assert " ".join(tab.inner_text("h1").split()) == flight.title
        assert tab.title() == flight.title
        assert flight.title.startswith(NAME[:80])
        assert elements(tab) == {"script": 2, "img": 0, "style": 1, "iframe": 0, "object": 0}
        told = json.loads(tab.locator("#flight").text_content())
        assert told == json.loads(json.dumps([page_contents(flight)]))
        tab.close()


def test_hostile_names_of_what_is_plotted_stay_text(browser: Any, log: Path, tmp_path: Path) -> None:
    """The script writes no name as HTML, whatever the page's data holds."""
    shown = read_log(log)
    (tmp_path / "page.html").write_text(flight_page(shown), encoding="utf-8")
    tab = opened(browser, tmp_path / "page.html", 1000)
    tab.evaluate(
        """(text) => new Plot(document.getElementById('plots'), { title: text, unit: text, series: [{ name: text,
             colour: `red"><img src=x onerror=document.title='gone'>`, value: (row) => row }] },
             player.panes[0].flight, [], player)""",
        TEXT,
    )
    plot = tab.locator(".plot").last
    assert plot.locator("h3").text_content() == f"{TEXT} [{TEXT}]"
    assert plot.locator(".legend span").text_content().strip() == TEXT
    assert elements(tab) == {"script": 2, "img": 0, "style": 1, "iframe": 0, "object": 0}
    tab.close()


def test_a_live_page_of_a_hostile_log(browser: Any, log: Path) -> None:
    live = LiveLog(log)
    view = LiveView(live)
    while view.update():
        pass
    server = Server(0, view)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
    try:
        tab = browser.new_page()
        tab.goto(f"http://127.0.0.1:{server.server_port}/")
        tab.wait_for_function("document.getElementById('status')?.textContent.startsWith('refused')")
        assert tab.locator("#status").text_content() == f"refused: {TEXT}"
        assert tab.title() == f"{NAME}.jsonl, live"
        assert elements(tab) == {"script": 2, "img": 0, "style": 1, "iframe": 0, "object": 0}
        tab.close()
    finally:
        server.shutdown()
        server.server_close()
        live.close()
