#!/usr/bin/env python3
"""The stylus, unplugged, in headless Chromium: its traces are grey within a second, and alive once it
is plugged in again.

    tests/browser/unplugged.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

import sys
import tempfile
import time
from pathlib import Path

from page import Live, scene, shot
from stylus import Stylus
from webdriver import Browser

STATION = """format = 1
[microphone]
present = false
[camera]
present = false
"""
GREY = "return document.querySelectorAll('.plot[data-stalled]').length"
ALL = "return document.querySelectorAll('.plot').length"


def alive(browser):
    return lambda: browser.run(ALL) >= 4 and browser.run(GREY) == 0


def check(browser, station, stylus, shots):
    browser.open(station.url + "/")
    browser.wait("live traces", alive(browser), 60)
    begin = time.monotonic()
    stylus.unplug()
    browser.wait("grey traces", lambda: browser.run(GREY) == browser.run(ALL), 5)
    took = time.monotonic() - begin
    print(f"grey after {took:.2f} s")
    assert took <= 1.0, f"grey after {took:.2f} s"
    assert "no data for" in browser.text(".plot span")
    browser.wait("what to do", lambda: "disconnected: plug it in" in browser.text("#advice"))
    browser.wait("the device lost", lambda: browser.run(
        "return ['lost', 'absent'].includes(document.querySelector('#devices li')?.dataset.state)"))
    shot(browser, shots, "unplugged")
    again = Stylus(stylus.link)
    browser.wait("live traces again", alive(browser), 30)
    again.unplug()


def main():
    surfaced, shots = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    with tempfile.TemporaryDirectory() as folder, Browser() as browser:
        folder = Path(folder)
        library, _ = scene(surfaced, folder, trials="6", users="0", kept=3)
        (folder / "station.toml").write_text(STATION)
        stylus = Stylus(folder / "stylus")
        station = Live(surfaced, "--library", library, "--config", folder / "station.toml", "--stylus", folder / "stylus")
        try:
            check(browser, station, stylus, shots)
        finally:
            station.end()
    print("no trace is frozen")


if __name__ == "__main__":
    main()
