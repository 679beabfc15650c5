#!/usr/bin/env python3
"""Each state of a station, as the person in front of it sees it, in headless Chromium: an emulated
stylus is dragged over surfaces that the library has and one that it lacks.

    tests/browser/states.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver), and axe-core (`pip install
axe-core-python`).
"""

import json
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path

from page import Live, run
from review import get, newest, shots_of
from stylus import Stylus, scan_of
from webdriver import Browser

ESCAPE = "\ue00c"
TOKEN = "0123456789abcdef"
STATION = """format = 1
[page]
stale_after_s = 600
[microphone]
present = false
[camera]
present = false
"""
# Everything that the page says of its state, as it changes.
WATCH = """
window.said = [];
const now = () => [document.getElementById('now').dataset.state, ...['word', 'name', 'sure'].map(id => document.getElementById(id).innerText)];
new MutationObserver(() => { const text = JSON.stringify(now()); if (said.at(-1) !== text) said.push(text); })
  .observe(document.getElementById('now'), { subtree: true, childList: true, characterData: true, attributes: true });
"""


class Stage:
    """A browser at a station with an emulated stylus."""

    def __init__(self, browser, station, stylus, shots):
        self.browser, self.station, self.stylus, self.shots = browser, station, stylus, shots

    def state(self):
        return self.browser.run("return document.getElementById('now').dataset.state")

    def until(self, state):
        try:
            self.browser.wait(state, lambda: self.state() == state)
        except AssertionError as error:
            raise AssertionError(f"{error}: {self.browser.text('#now')!r}") from error

    def seen(self, name):
        """No rule of accessibility is broken, by day and by night; and what it looks like."""
        for scheme in ("dark", "light"):
            self.browser.scheme(scheme)
            self.browser.accessible(f"{name}, {scheme}")
        shots_of(self.browser, self.shots, name)

    def play(self, scan, looks=lambda: None):
        """Plays a scan; `looks` during its drag. Gives what the page said of it, from first to last."""
        before = (newest(self.station) or {"scan": 0})["scan"]
        self.browser.run(WATCH)
        self.stylus.play(scan)
        self.browser.wait("the drag", lambda: self.state() in ("drag", "lift"))
        looks()
        self.browser.wait("the answer", lambda: (newest(self.station) or {"scan": 0})["scan"] > before)
        self.browser.wait("its state", lambda: self.state() not in ("drag", "lift", "idle"))
        return [json.loads(text) for text in self.browser.run("return window.said")], newest(self.station)


def known(stage, trial, surface):
    """A surface of the library: listening, then its name; the header agrees with the ranking."""
    said, answer = stage.play(scan_of(trial))
    names = [name for state, _, name, _ in said if state in ("drag", "lift")]
    # A busy browser misses some of it.
    assert surface in names and names == sorted(names, key=lambda name: name != "listening"), said
    assert set(names) <= {"listening", surface}, said
    assert all(word.startswith("Drag on") or word == "Done, lift" for state, word, *_ in said if state in ("drag", "lift")), said
    browser = stage.browser
    assert (stage.state(), browser.text("#name")) == ("named", surface), browser.text("#now")
    first = browser.text("#runners li b")
    assert browser.text("#sure").startswith(f"{first} sure") and "100" not in first, browser.text("#now")
    assert answer["state"] == "named" and answer["damage"] == []
    stage.seen("named")


def unknown(stage, trial, surfaces):
    """A surface that the library lacks is never named with certainty, from the first word on."""
    said, answer = stage.play(scan_of(trial))
    assert answer["state"] == "unknown", answer
    named = [line for line in said if line[0] in ("drag", "lift") and line[2] in surfaces]
    assert not named, f"named before it was unknown: {named}"
    assert any(state in ("drag", "lift") and name == "unknown" and sure.startswith("closest: ") for state, _, name, sure in said), said
    browser = stage.browser
    assert (stage.state(), browser.text("#name")) == ("unknown", "unknown")
    assert browser.text("#sure").startswith("closest: ") and "%" not in browser.text("#sure"), browser.text("#sure")
    assert browser.text("#runners") == "", "nothing is likely"
    stage.seen("unknown")

    # Its reasons are words, and the figures behind a click.
    browser.click("#why")
    browser.wait("its reasons", lambda: browser.run("return document.getElementById('scan').dataset.shown"))
    why = browser.text("#scan-body section")
    assert "differs too much from" in why and "p =" not in why, why
    stage.seen("unknown-why")
    # Its charts may still be drawn anew in other colours.
    browser.wait("its figures", lambda: browser.run(
        "const d = document.querySelector('#scan-body details'); if (d) d.open = true; return d?.innerText.includes('p = ')"))
    browser.keys(ESCAPE)


def damaged(stage, trial):
    """Damage stands beside the answer, in its row and in the counter."""
    browser = stage.browser

    def clipped(sample):
        return [x * 300 for x in sample[:3]] + sample[3:]

    badge = lambda: browser.wait("the badge", lambda: "is clipped in" in (browser.text("#damage") or ""))
    said, answer = stage.play(scan_of(trial, change=clipped), badge)
    assert stage.state() == "damaged" and browser.text("#word") == "Sensor fault", said
    assert "acceleration: channel " in browser.text("#damage") and "lower the gain" in browser.text("#damage")
    dead = lambda sample: sample[:5] + [0, sample[6]]
    said, answer = stage.play(scan_of(trial, change=dead))
    # The scan may hold a few samples from before or after the drag.
    text = answer["damage"][0]["text"]
    assert re.fullmatch(r"channel 1 is (stuck at 0|at 0 for 9\d % of the scan); check its cable", text), text
    assert [damage["source"] for damage in answer["damage"]] == ["ir"], answer["damage"]
    assert browser.text("#damage") == f"infrared: {text}", browser.text("#damage")
    assert browser.run("return document.querySelectorAll('#scans .badge.bad').length") == 2
    assert "2 with sensor faults" in browser.text("#counts"), browser.text("#counts")
    stage.seen("damaged")


def dialogues(stage, trial, surface):
    """Esc, the back button and links work for both dialogues."""
    browser, url = stage.browser, stage.station.url
    is_open = lambda dialog: browser.run("return document.getElementById(arguments[0]).open", dialog)
    hash_ = lambda: browser.run("return location.hash")
    row = "#scans tr.named:last-child button"
    for opener, dialog in ((row, "scan"), ("#shelf-open", "shelf")):
        for close in (lambda: browser.keys(ESCAPE), lambda: browser.run("history.back()"), lambda: browser.click(f"#{dialog}-close")):
            browser.click(opener)
            browser.wait(dialog, lambda: is_open(dialog))
            link = hash_()
            assert link.startswith("#scan=" if dialog == "scan" else "#library"), link
            close()
            browser.wait("the page", lambda: not is_open(dialog) and hash_() == "")
            browser.wait("the focus back", lambda: browser.run(
                "return document.activeElement === document.querySelector(arguments[0])", opener))
        browser.run("history.forward()")
        browser.wait("it again", lambda: is_open(dialog) and hash_() == link)
        browser.open("about:blank")
        browser.open(url + "/" + link)
        browser.wait("the link", lambda: is_open(dialog))
        if dialog == "scan":
            browser.wait("its reasons", lambda: browser.run("return document.getElementById('scan').dataset.shown"))
            why = browser.text("#scan-body section")
            assert f"It fits {surface}" in why and f" for {surface}" in why and "infrared" in browser.text("#scan-body"), why
        stage.seen(f"dialogue-{dialog}")
        browser.keys(ESCAPE)
        browser.wait("the page", lambda: not is_open(dialog) and hash_() == "")


def kiosk(stage, trial, surface):
    """The answer alone fills the screen, at any size, and the screen is asked to stay awake."""
    browser = stage.browser
    browser.open(stage.station.url + "/?view=kiosk")
    browser.wait("the lock of the screen", lambda: browser.run("return document.body.dataset.awake"))
    stage.play(scan_of(trial))
    for width, height in ((360, 740), (1280, 720), (1920, 1080), (800, 300)):
        browser.resize(width, height)
        size = browser.run("const r = document.getElementById('now').getBoundingClientRect(); return [r.width, r.height]")
        inside = browser.run("const e = document.documentElement; return [e.scrollWidth <= innerWidth, e.scrollHeight <= innerHeight + 1]")
        assert round(size[0]) == width and round(size[1]) >= height and all(inside), (size, inside, width, height)
    browser.resize(1280, 1000)
    shown = browser.run("return [...document.querySelectorAll('body *')].filter(e => e.checkVisibility() && e.innerText?.trim()"
                        " && !e.children.length && !e.closest('.hidden, header')).map(e => e.id)")
    assert set(shown) <= {"word", "name", "sure", "at", ""}, shown
    stage.seen("kiosk")
    browser.keys(ESCAPE)
    browser.wait("the page", lambda: browser.run("return !document.body?.dataset.view && location.search === ''"))
    browser.wait("its name", lambda: browser.text("#name") == surface)


def enrolment(stage, trials):
    """Progress, refusal and what to do about it stand in the place of the answer."""
    browser = stage.browser
    browser.run("document.getElementById('trials').value = 2")
    browser.type("#surface", "slate")
    browser.click("#enroll")
    text = lambda: (browser.text("#enrolling") or "")
    browser.wait("the order", lambda: "slate: 0 of 2 kept" in text())
    stage.stylus.play(scan_of(trials[0], 0.5))
    browser.wait("the refusal", lambda: "Last one refused: lifted after 0." in text() and "s needed" in text())
    assert browser.run("return document.getElementById('enrolling').closest('#now') !== null")
    stage.seen("enrolment-refused")
    browser.click("#enroll-keep")
    browser.wait("the trial", lambda: "slate: 1 of 2 kept" in text() and "refused" not in text())
    stage.stylus.play(scan_of(trials[1]))
    browser.wait("the last", lambda: not browser.run("return document.getElementById('enrolling').checkVisibility()"))
    browser.wait("the library with slate", lambda: any(
        s == {"surface": "slate", "trials": 2} for s in get(stage.station, "/api/v1/library")["surfaces"]))
    stage.seen("enrolled")


def disconnected(stage):
    """Unplugged is an alarm, which says since when, and nothing says that all is well."""
    browser = stage.browser
    begin = time.monotonic()
    stage.stylus.unplug()
    grey = "return [...document.querySelectorAll('.plot')].every(p => p.dataset.stalled)"
    browser.wait("grey traces", lambda: browser.run(grey))
    print(f"grey {time.monotonic() - begin:.2f} s after the stylus was unplugged")
    assert "no data for" in browser.text(".plot")
    stage.until("disconnected")
    assert browser.text("#word") == "Stylus disconnected: plug it in"
    browser.wait("the time", lambda: re.match(r"for ([2-9]|\d\d+) s, since ", browser.text("#sure")))
    assert "nothing lost" not in browser.text("main"), browser.text("main")
    stage.seen("disconnected")
    stage.stylus = Stylus(stage.stylus.link, noise=3)
    browser.wait("live traces again", lambda: browser.run("return !document.querySelector('.plot[data-stalled]')"))
    browser.wait("the answer again", lambda: stage.state() != "disconnected")


def empty(surfaced, browser, folder, shots):
    """A station without a library shows three steps, and a browser asks a person for the token."""
    nothing = folder / "nothing"
    nothing.mkdir()
    (folder / "empty.toml").write_text(STATION)
    link = folder / "none"
    station = Live(surfaced, "--library", nothing, "--config", folder / "empty.toml", "--stylus", link, env={"SURFACED_TOKEN": TOKEN})
    stage = Stage(browser, station, None, shots)
    try:
        browser.open(station.url + "/")
        assert browser.text("button") == "Open the page", browser.text("body")
        stage.seen("token")
        browser.type("input", "wrong")
        browser.click("button")
        browser.wait("the refusal", lambda: "This token is not right." in (browser.text("body") or ""))
        stage.seen("token-wrong")
        browser.type("input", TOKEN)
        browser.click("button")
        browser.wait("the steps", lambda: browser.run("return document.getElementById('steps')?.checkVisibility()"))
        assert browser.run("return location.href") == station.url + "/"
        assert str(nothing) not in browser.text("main"), "no path"
        assert "Name a surface" in browser.text("#steps"), browser.text("#now")
        stage.seen("empty")
        stylus = Stylus(link, noise=3)
        browser.wait("the first step done", lambda: browser.run("return document.getElementById('step-plug').dataset.done") == "true")
        stylus.unplug()
    finally:
        browser.open("about:blank")
        station.end()


def prepared(surfaced, folder):
    """A library, its surfaces, and recordings to play: two of each surface and of one that it lacks. Some surfaces
    are so like others that thirty trials do not tell them apart from the first word on; these are not."""
    made, library = folder / "made", folder / "library"
    run(surfaced, "synth", made, "--surfaces", "6", "--trials", "12", "--users", "0", "--seconds", "1.5")
    strange, _, _, *surfaces = sorted(path.name for path in made.iterdir() if path.is_dir())
    played = {surface: sorted((made / surface).glob("expert-*"))[-2:] for surface in [*surfaces, strange]}
    library.mkdir()
    shutil.copy(made / "library.toml", library)
    for surface in surfaces:
        for trial in sorted((made / surface).glob("expert-*"))[:-2]:
            for source in ("ac", "fr", "ir", "me"):
                (library / surface / trial.name).mkdir(parents=True, exist_ok=True)
                shutil.copy(trial / f"{source}.wav", library / surface / trial.name)
    return library, surfaces, strange, played


def main():
    surfaced, shots = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    with tempfile.TemporaryDirectory() as folder, Browser() as browser:
        folder = Path(folder)
        empty(surfaced, browser, folder, shots)
        # A refused token is in the console.
        browser.log("browser")
        library, surfaces, strange, played = prepared(surfaced, folder)
        (folder / "station.toml").write_text(STATION)
        stylus = Stylus(folder / "stylus", noise=3)
        station = Live(surfaced, "--library", library, "--config", folder / "station.toml", "--stylus", folder / "stylus")
        stage = Stage(browser, station, stylus, shots)
        try:
            browser.open(station.url + "/")
            browser.wait("a station that is ready", lambda: browser.text("#word") == "Ready")
            stage.seen("ready")
            known(stage, played[surfaces[0]][0], surfaces[0])
            unknown(stage, played[strange][0], surfaces)
            damaged(stage, played[surfaces[1]][0])
            dialogues(stage, played[surfaces[0]][1], surfaces[0])
            kiosk(stage, played[surfaces[0]][1], surfaces[0])
            enrolment(stage, played[strange])
            disconnected(stage)
            console = browser.log("browser")
            assert not console, f"the console stays empty: {console}"
        finally:
            stage.stylus.unplug()
            station.end()
    print("each state is seen")


if __name__ == "__main__":
    main()
