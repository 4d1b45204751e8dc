#!/usr/bin/env python3
"""Make the still pictures of the pages: `python docs/pictures.py [NAME ...] [--out DIR]`, all without a name.

The pictures `tutorial-*` come from the commands of docs/tutorial.md, run one after the other in a directory of their
own: some minutes. `viewer`, `tutorial-report` and one of `notebook` are screenshots and need a Chromium and Playwright.
docs/readme_picture.py makes the moving picture.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import html
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from supervisor_picture import state_chart

import leaderboard
from leaderboard import KINDS
from mjxball import Policy, Scenario, simulate
from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.bench import CONDITIONS
from mjxball.bench.tracks import TRACKS
from mjxball.evaluate.paper_figures import plot_figure
from mjxball.evaluate.plots import PANELS, plot_flights
from mjxball.evaluate.results import fly_scenarios, scenario_title
from mjxball.evaluate.scenarios import REFERENCE
from mjxball.files import write_atomically
from mjxball.notebook import View
from mjxball.plant import plant_parameters
from mjxball.plant.rotors import PLACES, SPIN
from mjxball.plotting import (
    BLUE,
    BROWN,
    GREEN,
    INK,
    OLIVE,
    PINK,
    follower_styles,
    legend_above,
    line,
    pyplot,
    rendered,
    save,
    series_styles,
)
from mjxball.policy.file import policy_path, shipped_policy
from mjxfly.gain_design import apply, design
from mjxfly.log import result_of, without_goal
from mjxfly.margins import FREQUENCIES, closed_poles, delivered_gains, loop_gain
from mjxfly.recording import read_recording

REPOSITORY = Path(__file__).parents[1]
RESULTS = REPOSITORY / "benchmarks" / "results"
X, Y, Z, ERROR, CG, ROLL, PITCH, VERTICAL = PANELS
BROWSERS = ("chromium-headless-shell", "chromium", "google-chrome")
NOTEBOOK = REPOSITORY / "docs" / "notebooks" / "first_follower.ipynb"
INKED = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
PRINTED = dict.fromkeys(INKED, "black")  # of a picture on white
COLOURS_OF_PNG = 256
WIDTH = 77  # of quoted lines, which fit the page


def flights(names: list[str | Path], scenario: Scenario, path: Path, panels: tuple[Any, ...] = (X, ERROR, CG)) -> None:
    """Classical followers and policies by their names, or policy files, on one scenario of the preset `transport`."""
    config = configs.preset("transport")
    classical = ("copy", "lqg")
    followers: list[Any] = [
        make_baseline(str(name), config) if name in classical else Policy.load(policy_path(str(name))) for name in names
    ]
    flown = fly_scenarios(config, followers, [scenario], "newton-euler")
    plot_flights(flown, scenario_title(flown[0]), path, panels)


def copying(out: Path) -> None:
    """Page mimicking: what copying the leader does to the object."""
    flights(["copy", "lqg", "transport-large"], REFERENCE, out / "copying.svg")


def cancels(out: Path) -> None:
    """Page index: the follower's pitch command less the leader's, on top of what cancels the CG."""
    config = configs.preset("transport")
    plant, stiffness = config.plant, plant_parameters(config.plant, config.attitude).gains.kp[1]
    followers = [make_baseline(name, config) for name in ("copy", "lqg")]
    followers.append(Policy.load(shipped_policy("balance")))
    looks = follower_styles([one.name for one in followers])
    with pyplot().rc_context(PRINTED):
        figure, axis = pyplot().subplots(figsize=(5, 3), layout="constrained")
        for number, follower in enumerate(followers):
            flown = simulate(config, follower, REFERENCE, "newton-euler")
            if not number:
                needed = -plant.object_mass * plant.gravity * flown.cg_offset / stiffness
                axis.plot(flown.time, needed, color="0.8", linewidth=6, label="what cancels the CG")
            less = flown.follower_command[:, 1] - flown.leader_command[:, 1]
            look, name = line(looks[follower.name]), follower.name
            if name == "balance":  # with exact sensors it circles by millimetres about its hover
                axis.plot(flown.time, less, **{**look, "linewidth": 0.6, "alpha": 0.5}, label=name)
                less, name = np.convolve(less, np.ones(100) / 100, "same"), f"{name}, mean of 2 s"
            axis.plot(flown.time, less, **look, label=name, zorder=4 - number)
        axis.set(xlabel="time [s]", ylabel="pitch command [rad],\nfollower less leader", xlim=(5, 44), ylim=(-0.1, 0.1))
        axis.grid()
        legend_above(figure, [axis], 2)
        write_atomically(out / "cancels.svg", on_white(rendered(figure, "svg")))


def on_white(picture: bytes) -> bytes:
    """An SVG with a white background."""
    return re.sub(rb"(<svg[^>]*>)", rb'\1<rect width="100%" height="100%" fill="white"/>', picture, count=1)


def notebook(out: Path) -> None:
    """What the cells of the notebook print and draw, in `out`/notebooks, which `_site/notebooks.py` shows."""
    names: dict[str, Any] = {}
    (out / "notebooks").mkdir(exist_ok=True)
    with pyplot().rc_context(PRINTED):
        for cell in json.loads(NOTEBOOK.read_text())["cells"]:
            if cell["cell_type"] == "code":
                place, printed = out / "notebooks" / f"{NOTEBOOK.stem}-{cell['id']}", io.StringIO()
                with contextlib.redirect_stdout(printed):
                    last = run_cell("".join(cell["source"]), names)
                if text := printed.getvalue():
                    write_atomically(place.with_suffix(".txt"), text.encode())
                for number in pyplot().get_fignums():
                    drawn = rendered(pyplot().figure(number), "svg")
                    write_atomically(place.with_suffix(".svg"), on_white(drawn))
                if isinstance(last, View):
                    (page,) = re.findall(r'srcdoc="([^"]*)"', last._repr_html_())
                    with tempfile.TemporaryDirectory() as name:
                        (Path(name) / "page.html").write_text(html.unescape(page))
                        screenshot(Path(name) / "page.html", place.with_suffix(".png"), 900, 560)


def run_cell(code: str, names: dict[str, Any]) -> Any:
    """Run the code of a cell in `names`; the value of its last line if that is an expression."""
    tree = ast.parse(code)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    return eval(compile(ast.Expression(last.value), "cell", "eval"), names) if isinstance(last, ast.Expr) else None


def flight(out: Path) -> None:
    """Page tutorial: the flight of its program."""
    flights(["copy", "balance"], Scenario(omega=1.0, amplitude=0.08), out / "flight.svg", (X, ERROR, PITCH))


def crazyflie_stand(out: Path) -> None:
    """Archive, page crazyflie: `python eval.py figures --only stand --out figures`."""
    policy = Policy.load(shipped_policy("stand"))
    (out / "crazyflie-stand.svg").write_bytes(plot_figure("stand", [policy], "newton-euler").picture)


def crazyflie_gains(out: Path) -> None:
    """Page crazyflie: steps, poles and loop gain of the pair, with delivered and with computed gains."""
    sys.path.append(str(REPOSITORY / "tests"))
    from attitude_trials import Trial, pair, simulate

    config, delay, lags, ends = configs.preset("flight"), 0.01, (0.03, 0.05, 0.1, 0.15), (-12.0, 28.0)
    designs = design(config)
    worst = max(designs, key=lambda one: one.axis.inertia_ratio)
    axis, number = worst.axis, ("roll", "pitch", "yaw").index(worst.axis.name)
    delivered = configs.Autopilot(kind="crazyflie", motor_curve=config.autopilot.motor_curve)
    autopilots = {"delivered": delivered, "computed": apply(config.autopilot, tuple(designs))}
    gains = {"delivered": delivered_gains(axis), "computed": worst.gains}
    looks = {name: line(look) for name, look in series_styles([*gains]).items()}
    figure, named = pyplot().subplot_mosaic("AA;BC", figsize=(7.5, 6.5), layout="constrained")
    places = [*named.values()]
    for name, look in looks.items():
        step = tuple(8.0 * (k == number) for k in range(3))
        angles = simulate(pair(config), autopilots[name], [Trial(step, lag=lag, delay=delay) for lag in lags])
        for angle, width in zip(angles[..., number].T, np.linspace(0.6, 2.2, len(lags)), strict=True):
            outside = np.flatnonzero((angle < ends[0]) | (angle > ends[1]))
            last = outside[0] if len(outside) else len(angle)
            time = 0.002 * np.arange(last)
            places[0].plot(time, angle[:last], **{**look, "linewidth": width}, label=name)
            if len(outside):
                places[0].plot(time[-1], angle[last - 1], "x", color=look["color"], clip_on=False)
        marks = {"color": look["color"], "marker": "o" if name == "delivered" else "s", "linestyle": "none"}
        for scale in np.geomspace(1 / axis.inertia_ratio, 2.0, 40):
            poles = closed_poles(gains[name], axis.gain / scale, config.plant.rotor_lag, delay)
            places[1].plot(poles.real, poles.imag, markersize=1.5, alpha=0.6, **marks)
        poles = closed_poles(gains[name], axis.gain, config.plant.rotor_lag, delay)
        places[1].plot(poles.real, poles.imag, markersize=8, markerfacecolor="none", **marks, label=f"{name}, the pair")
        value = loop_gain(gains[name], axis.gain, config.plant.rotor_lag, delay, FREQUENCIES)
        angle = np.degrees(np.unwrap(np.angle(value)))
        angle += -360 * np.round((angle[np.argmin(np.abs(np.abs(value) - 1))] + 180) / 360)
        places[2].plot(angle, 20 * np.log10(np.abs(value)), **look)
    places[0].set(xlabel="time [s]", ylabel=f"{axis.name} [degrees]", ylim=ends)
    places[0].set_title("8 degree step, motor lag 30 to 150 ms (thin to thick); cross: leaves the panel", fontsize=10)
    places[1].axvline(0, color=INK, linewidth=0.8)
    places[1].set(xlim=(-25, 8), ylim=(-25, 25), xlabel="real [1/s]", ylabel="imaginary [1/s]")
    places[1].set_title("Poles, inertia from one drone's\nto twice the pair's", fontsize=10)
    places[2].plot([-180], [0], "+", color=INK, markersize=12, markeredgewidth=2)
    places[2].set(xlim=(-280, -80), ylim=(-40, 40), xlabel="phase [degrees]", ylabel="loop gain [dB]")
    places[2].set_title("Loop gain against phase\nplus: instability", fontsize=10)
    legend_above(figure, places[:2])
    save(figure, out / "crazyflie-gains.svg")


def supervisor(out: Path) -> None:
    """Page flying: the flight supervisor as a state machine, from its table of transitions."""
    (out / "supervisor.svg").write_text(state_chart())


CURVES = {  # label: results of benchmarks/first_command.py
    "gradients (quick), two cores": "success_curve_gradient",
    "SAC on MJX (transport), two cores": "success_curve_sac",
    "Brax's SAC (transport), two cores": "success_curve_brax",
}


def success_curves(out: Path) -> None:
    """Page results: success against seconds since the command began, beside the best classical follower."""
    figure, panels = pyplot().subplots(1, 2, figsize=(8, 4), sharey=True, layout="constrained")
    looks = series_styles([*CURVES, "best classical"])
    for panel, condition in zip(panels, CONDITIONS, strict=True):
        for label, name in CURVES.items():
            (row,) = json.loads((RESULTS / f"{name}.json").read_text())["rows"]
            points = [(one["seconds"], 100 * one[condition]) for one in row["curve"]]
            panel.plot(*zip(*points, strict=True), **looks[label] | {"markersize": 4}, label=label)
        share, _ = leaderboard.best(KINDS["classical"], "pair", condition)
        panel.axhline(share, **line(looks["best classical"]), label="best classical")
        panel.set(xlabel="seconds since the command began", title=condition, ylim=(-3, 100))
        panel.grid()
    panels[0].set_ylabel("success, track pair [%]")
    legend_above(figure, panels, 3)
    save(figure, out / "success-curves.svg")


def best(out: Path) -> None:
    """README: the best learned and the best classical follower of each track and condition."""
    figure, panels = pyplot().subplots(1, 2, figsize=(8, 4.2), sharey=True, layout="constrained")
    tracks = list(TRACKS)
    for panel, condition in zip(panels, CONDITIONS, strict=True):
        for place, (kind, look) in enumerate(series_styles(list(KINDS)).items()):
            found = [leaderboard.best(KINDS[kind], track, condition) for track in tracks]
            rows = np.arange(len(tracks)) + 0.4 * place - 0.2
            panel.barh(rows, [max(share, 0.0) for share, _ in found], 0.36, color=look["color"], label=kind)
            for row, (share, entries) in zip(rows, found, strict=True):
                who = ", ".join(entry["follower"] for entry in entries) if entries else "not flown"
                text, inside = f"{who} {share:.0f}" if entries else who, share > 50
                panel.text(
                    share + (-1.5 if inside else 1.5) if entries else 1.5,
                    *(row, text),
                    **{"ha": "right" if inside else "left", "va": "center", "fontsize": 9},
                    **({"color": "white"} if inside else {}),
                )
        panel.set(xlim=(0, 100), xlabel="success [%]", title=condition)
    panels[0].set_yticks(np.arange(len(tracks)), [TRACKS[track].title for track in tracks])
    panels[0].invert_yaxis()
    legend_above(figure, panels[:1])
    save(figure, out / "best.svg")


def frames(out: Path) -> None:
    """Page model: the pair from above and from its right side, not to scale."""
    plt = pyplot()
    figure, (top, side) = plt.subplots(
        2, 1, figsize=(4.6, 4.65), height_ratios=(3.9, 3.3), layout="constrained", sharex=True
    )
    mounts, arm, cg, spin_radius = {"leader": 2.4, "follower": -2.4}, 1.1, 0.7, 0.44

    def arrow(axis: Any, begin: tuple[float, float], end: tuple[float, float], colour: str) -> None:
        look = {"arrowstyle": "-|>", "color": colour, "lw": 1.8, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 11}
        axis.annotate("", end, begin, arrowprops=look, zorder=6)

    def label(axis: Any, place: tuple[float, float], words: str, colour: str = "black") -> None:
        axis.text(*place, words, color=colour, fontsize=11, ha="center", va="center", zorder=7)

    for number, (name, middle) in enumerate(mounts.items()):
        for rotor, (place, moment) in enumerate(zip(PLACES["plus"], SPIN["plus"], strict=True), start=1):
            x, y = middle + arm * place[0], arm * place[1]
            colour = BLUE if moment > 0 else BROWN
            top.plot([middle, x], [0, y], color=INK, linewidth=2)
            top.add_patch(plt.Circle((x, y), spin_radius, facecolor="white", edgecolor="0.8", zorder=3))
            # A rotor turns against the moment that it exerts on its drone.
            turn = np.radians(np.linspace(150, 390, 40)[::-moment])
            around = np.array([x + spin_radius * np.cos(turn), y + spin_radius * np.sin(turn)]).T
            top.plot(*around.T, color=colour, linewidth=1.6, zorder=4)
            arrow(top, tuple(around[-6]), tuple(around[-1]), colour)
            label(top, (x, y), str(rotor), colour)
        arrow(side, (0, -0.3), (middle, -0.3), PINK)
        label(side, (0.62 * middle, -0.62), f"r{'₀₁'[number]}", PINK)
        label(top, (middle, 1.9), name)
        side.plot([middle - arm, middle + arm], [0, 0], color=INK, linewidth=2)
        for x in (middle - arm, middle, middle + arm):
            ends, colour = [x - spin_radius, x + spin_radius], BROWN if x == middle else BLUE
            side.plot(ends, [0.08, 0.08], color=colour, linewidth=3)
        arrow(side, (middle, 0.1), (middle, 1.1), GREEN)
        label(side, (middle + 0.36, 0.9), f"T{'₀₁'[number]}", GREEN)
        label(side, (middle, 1.4), name)
    for axis, up, corner in ((top, "y", (-0.4, -1.5)), (side, "z", (-4.0, -1.45))):
        axis.add_patch(plt.Rectangle((-2.4, -0.15), 4.8, 0.3, color="0.85", zorder=0))
        for word, x, y in (("x", 0.8, 0.0), (up, 0.0, 0.8)):
            arrow(axis, corner, (corner[0] + x, corner[1] + y), "black")
            label(axis, (corner[0] + 1.25 * x, corner[1] + 1.25 * y), word)
        axis.plot([0], [0], "o", color="black", markersize=5, zorder=8)
        axis.plot([cg], [0], "s", color=OLIVE, markersize=8, zorder=8)
        label(axis, (0, 0.42), "O")
        label(axis, (cg, 0.42), "CG", OLIVE)
        axis.set(xlim=(-4.1, 4.1), aspect="equal")
        axis.axis("off")
    arrow(side, (0, 0), (cg, 0), OLIVE)
    label(side, (0.5 * cg, -0.62), "c", OLIVE)
    arrow(side, (cg, 0), (cg, -1.3), OLIVE)
    label(side, (cg + 1.3, -1.2), "load's weight", OLIVE)
    top.set(ylim=(-1.75, 2.15))
    side.set(ylim=(-1.65, 1.65))
    top.set_title("from above: x forward, y left", color="black", fontsize=11)
    side.set_title("from the right: x forward, z up", color="black", fontsize=11)
    write_atomically(out / "frames.svg", on_white(rendered(figure, "svg")))


def own_rig(out: Path) -> None:
    """Page own-rig: the plan of its `tri.toml` by `python -m mjxfly.rig.design`."""
    text = (REPOSITORY / "docs" / "howto" / "own-rig.md").read_text()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (rig,) = re.findall(r"^```toml\n(# tri\.toml\n.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
        (place / "tri.toml").write_text(rig)
        run(shlex.split("python -m mjxfly.rig.design --plant tri.toml --out plan.svg"), place)
        write_atomically(out / "own-rig.svg", on_white((place / "plan.svg").read_bytes()))


def viewer(out: Path) -> None:
    """Page view: `python -m mjxball.view balance`."""
    with tempfile.TemporaryDirectory() as place:
        page = Path(place) / "page.html"
        command = "python -m mjxball.view balance --omega 1 --amplitude 0.1 --out"
        run([*shlex.split(command), str(page)], Path(place))
        screenshot(page, out / "viewer.png")


def tutorial(out: Path) -> None:
    """Page tutorial: its commands, and what they leave."""
    from mjxball.train.curves import plot_training

    text = (REPOSITORY / "docs" / "tutorial.md").read_text()
    blocks = "".join(re.findall(r"^```bash\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE))
    blocks = blocks[blocks.index("python train.py") :]  # what comes before opens a browser
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        commands = [line for line in blocks.replace("\\\n", " ").splitlines() if line.startswith("python ")]
        printed = "".join(run(shlex.split(command, comments=True), place) for command in commands)
        excerpts(printed, (place / "first.h").read_text(), out)
        first = place / "runs" / "first"
        plot_training(first, configs.preset("transport"), out / "tutorial-training.svg")
        flights(["copy", first / "policy.npz"], REFERENCE, out / "tutorial-flight.svg")
        screenshot(place / "report" / "report.html", out / "tutorial-report.png")
        screenshot(place / "first.html", out / "tutorial-viewer.png")
        flown = read_recording(place / "first.jsonl")
        log = without_goal(result_of(flown, "first, flown"), flown.guided_rows)
        plot_flights([log], "Rehearsal on the twin", out / "tutorial-rehearsal.svg", (Z, ERROR, ROLL))


def excerpts(printed: str, header: str, out: Path) -> None:
    """What the page quotes of the lines that its commands have `printed`, and of the C: no times of the machine."""
    lines = re.split(r"[\r\n]+", printed)
    final = [line for line in lines if re.search(r"^ *768,000 steps  eval return", line)][-1]
    head = next(k for k, line in enumerate(lines) if line.split()[:3] == ["omega", "ampl.", "mass"])
    rows = [line for line in lines[head:] if line.startswith("*")][:2]
    table = [line[:WIDTH].rstrip() for line in [*lines[head : head + 2], *rows]]
    landed = next(line for line in lines if line.startswith("landed"))
    checked = [line for line in lines if line.startswith("good")]
    figures = next(one for one in lines if one.startswith("error rms"))
    told = [
        line.removeprefix(" *").strip() for line in header.splitlines() if line.startswith((" *   mjx", " *   int"))
    ]
    texts = {
        "training": [final.partition("  100%")[0].strip(), "policy: runs/first/policy.npz"],
        "results": [*table, *(line.partition(";")[0] for line in lines if "meets the bounds" in line)],
        "export": [re.sub(r";  +(.*)", r";  // \1", line) for line in told],
        "rehearsal": [checked[0], "...", checked[-1], landed, *figures.split("; ")],
    }
    for name, text in texts.items():
        (out / f"tutorial-{name}.txt").write_text("\n".join(text) + "\n")


def run(words: list[str], place: Path) -> str:
    """What one command of a page prints in the directory `place`."""
    program = [str(REPOSITORY / words[1]), *words[2:]] if words[1].endswith(".py") else words[1:]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    command: dict[str, Any] = {"cwd": place, "env": environment, "text": True}
    for _ in range(3 if "--rehearse" in words else 1):  # a busy machine misses the deadlines of a rehearsal
        done = subprocess.run(
            [sys.executable, *program], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False, **command
        )
        print(done.stdout, flush=True)  # noqa: T201
        if not done.returncode:
            return done.stdout
        (place / "first.jsonl").unlink(missing_ok=True)
    raise SystemExit(f"{shlex.join(words)} ended with {done.returncode}")


def screenshot(page: Path, path: Path, width: int = 1200, height: int = 800) -> None:
    """`page` as a browser shows it after 8 s of its flight, in few colours."""
    from PIL import Image
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, BROWSERS)))
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": width, "height": height})
        tab.goto(page.as_uri())
        for _ in range(80):
            tab.keyboard.press("ArrowRight")
        tab.wait_for_timeout(500)
        picture = Image.open(io.BytesIO(tab.screenshot()))
        browser.close()
    picture.convert("RGB").quantize(
        COLOURS_OF_PNG, Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE
    ).save(path, optimize=True)


PICTURES: dict[str, Callable[[Path], None]] = {
    "best": best,
    "cancels": cancels,
    "notebook": notebook,
    "copying": copying,
    "flight": flight,
    "crazyflie-stand": crazyflie_stand,
    "crazyflie-gains": crazyflie_gains,
    "supervisor": supervisor,
    "success-curves": success_curves,
    "frames": frames,
    "own-rig": own_rig,
    "viewer": viewer,
    "tutorial": tutorial,
}


MADE = (
    *(
        f"{name}.svg"
        for name in ("best", "cancels", "copying", "flight", "crazyflie-stand", "crazyflie-gains", "success-curves")
    ),
    "supervisor.svg",
    "frames.svg",
    "own-rig.svg",
    "viewer.png",
    *(f"tutorial-{name}" for name in ("training.svg", "flight.svg", "report.png", "viewer.png", "rehearsal.svg")),
    *(f"tutorial-{name}.txt" for name in ("training", "results", "export", "rehearsal")),
)


def main() -> None:
    """Make the pictures that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PICTURES))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, metavar="DIR")
    options = parser.parse_args()
    for name in options.names or PICTURES:
        PICTURES[name](options.out)


if __name__ == "__main__":
    main()
