"""Draw `img/identification.svg`: the worked example of the page on identification, and print its numbers.

Take `img/identification-page.png`, a picture of the page on the same logs, in Chromium (`apt-get install chromium`).
"""

from __future__ import annotations

import io
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.intervals import Errors
from pipeline.measured.identification.likelihood import columns_of, moments_of
from pipeline.measured.identification.recordings import Recording
from pipeline.measured.identification.scatter import solve
from pipeline.measured.identification.search import refined

FILE = Path(__file__).parent / "img" / "identification.svg"
PICTURE, SIZE, COLOURS = FILE.with_name("identification-page.png"), (1440, 1000), 128
T, ROWS, EDGE = 1e-3, 300, 20
MASS, DAMPING, FRICTION, DELAY, NOISE, QUANTUM = 0.6, 4.0, 0.15, 2.4, 3e-5, 1e-5
STEPS = (4.0, -4.0, 5.0, -5.0, 6.0, -6.0, 8.0, -8.0)
FINE = 200


def recorded(step: float, seed: int) -> Recording:
    """Return a log of a mass with damping and Coulomb friction, by 200 small steps a sample."""
    random, command = np.random.default_rng(seed), step * (np.arange(ROWS) >= EDGE)
    x, v, position, h = 0.0, 0.0, np.zeros(ROWS), T / FINE
    for row in range(ROWS):
        position[row] = QUANTUM * np.round((x + NOISE * random.standard_normal()) / QUANTUM)
        for part in range(FINE):
            late = row - int(np.ceil(DELAY - part / FINE))
            force = command[max(late, 0)] - DAMPING * v
            force -= FRICTION * np.sign(v) if v else np.clip(force, -FRICTION, FRICTION)
            v += force / MASS * h
            x += v * h
    return Recording(f"{step:g} N", T * np.arange(ROWS), command, position, T)


def picture(logs: list[Recording]) -> None:
    """Write the page on the logs, and take a picture of its first part."""
    from PIL import Image
    from playwright.sync_api import sync_playwright

    import pipeline

    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        os.chdir(folder)  # names of logs are short
        Path("logs").mkdir()
        for number, log in enumerate(logs):
            rows = zip(log.time.tolist(), log.command.tolist(), log.position.tolist(), strict=True)
            lines = ["# motion: translation", "time_s,command,position", *(f"{t!r},{u!r},{x!r}" for t, u, x in rows)]
            Path("logs", f"step_{number}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        page = pipeline.identify("logs").write_report("motor.html").resolve()
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        opened = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]}, color_scheme="light")
        opened.goto(page.as_uri())
        drawn = Image.open(io.BytesIO(opened.screenshot())).convert("RGB")
        drawn.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(PICTURE, optimize=True)
        browser.close()
        os.chdir(before)


def main() -> None:
    """Identify the device, and draw its prediction errors and the profile of the likelihood along the delay."""
    plt.rcParams |= {"svg.hashsalt": "pipeline", "svg.fonttype": "none"}
    logs = [recorded(step, seed) for seed, step in enumerate(STEPS)]
    result = identified(logs)
    for name, each in result.parameters.items():
        print(f"{name}: {each.value:.5g} [{each.low:.5g}, {each.high:.5g}]")
    print("parts", {name: round(gain, 1) for name, gain in result.parts.items()}, "fit", result.fit_percent)
    fit, segments = result.choice.fit, result.choice.segments
    figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3), layout="constrained")
    numbers = {name: value for name, value in fit.device.numbers.items() if name != "coulomb"}
    without = refined(segments, replace(fit.device, numbers=numbers, effects=None), far=False, noisy=False).device
    longest = int(np.argmax(segments.rows))
    for device, label in ((without, "best device without friction"), (fit.device, "with friction")):
        device = replace(device, effects=None)
        columns = columns_of(segments, device, ())
        errors = columns.values[columns.first[longest] : columns.behind[longest], -1] * result.units.position * 1e3
        left.plot(
            T * 1e3 * segments.time[segments.first[longest] : segments.behind[longest]],
            errors,
            label=label,
            linewidth=0.8,
        )
    left.set_xlabel("time [ms]")
    left.set_ylabel("prediction error [mm]")
    left.legend(frameon=False, fontsize="small")
    delays = np.linspace(-0.08, 0.08, 25) + fit.device.numbers["delay"]
    others = tuple(name for name in fit.device.names if name != "delay")
    varying = [fit.device.names[place] for place in fit.places.tolist()]
    scattered = np.array([others.index(name) for name in varying if name in others], dtype=np.int64)
    profile = []
    for delay in delays.tolist():
        device = replace(fit.device, numbers=fit.device.numbers | {"delay": delay}, effects=None)
        profile.append(solve(moments_of(segments, device, others), scattered).likelihood)
    right.plot(delays, np.array(profile) - max(profile), "o-", markersize=3)
    interval = Errors.of(fit).parameter("delay_samples", result.units)
    right.axvspan(interval.low, interval.high, alpha=0.2, label="95 %, no lag")
    print(f"delay without a lag: [{interval.low:.5g}, {interval.high:.5g}]")
    right.axvline(DELAY, color="black", linewidth=0.8, label="true")
    right.set_xlabel("delay [samples]")
    right.set_ylim(-12, 1)
    right.set_ylabel("log-likelihood less its largest")
    right.legend(frameon=False, fontsize="small")
    figure.savefig(FILE, metadata={"Date": None})
    picture(logs)


if __name__ == "__main__":
    main()
