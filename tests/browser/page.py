#!/usr/bin/env python3
"""The operator's page in headless Chromium, on a replay at real speed.

    tests/browser/page.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

import json
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from webdriver import Browser

# Seconds that each synthetic scan lasts.
DRAG = "2.0"
TAB = "\ue004"
ENTER = "\ue007"


def run(*command):
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)


def scene(surfaced, folder, trials="14", users="1", kept=3, seconds=DRAG):
    """A library of two surfaces with `kept` trials each, and recordings of a third by the same hand,
    to play."""
    made = folder / "made"
    run(surfaced, "synth", made, "--surfaces", "3", "--trials", trials, "--users", users, "--seconds", seconds)
    library, data = folder / "library", folder / "data"
    for part in (library, data):
        part.mkdir()
        (part / "library.toml").write_bytes((made / "library.toml").read_bytes())
    surfaces = sorted(path for path in made.iterdir() if path.is_dir())
    for surface in surfaces:
        recorded = sorted(surface.glob("expert-*"))
        place, moved = (data, recorded) if surface is surfaces[0] else (library, recorded[:kept])
        (place / surface.name).mkdir()
        for trial in moved:
            trial.rename(place / surface.name / trial.name)
    return library, data


class Live:
    """`surfaced run … --serve` until a signal ends it."""

    COMMAND = "run"

    def __init__(self, surfaced, *options, env={}):
        command = [surfaced, self.COMMAND, *options, "--serve=127.0.0.1:0", "--json"]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env={**os.environ, **env})
        said = []
        for line in self.process.stderr:
            said.append(line)
            if found := re.fullmatch(r"(http://\S+)\n", line):
                self.url = found[1]
                return
        raise AssertionError("no address on stderr: " + "".join(said))

    def end(self):
        self.process.send_signal(signal.SIGTERM)
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, [json.loads(line) for line in out.splitlines()], err


class Station(Live):
    """`surfaced replay … --serve` likewise, at real speed."""

    COMMAND = "replay"

    def __init__(self, surfaced, library, data, *options):
        super().__init__(surfaced, data, "--library", library, "--speed", "1.0", *options)


def requests(browser):
    """Where the page has asked for anything."""
    urls = []
    for entry in browser.log("performance"):
        message = json.loads(entry["message"])["message"]
        if message["method"] == "Network.requestWillBeSent":
            urls.append(message["params"]["request"]["url"])
    return urls


def pixels(browser):
    script = "return [...document.querySelectorAll('canvas')].map(c => c.toDataURL()).join()"
    return browser.run(script)


def frames(browser):
    return int(browser.run("return document.getElementById('plots').dataset.frames"))


def cadence(station):
    """Seconds of signal that an event of traces brings: the median of sixty."""
    spans = []
    with urllib.request.urlopen(station.url + "/api/v1/events?types=trace", timeout=60) as stream:
        for line in stream:
            if line.startswith(b"data: "):
                streams = json.loads(line.removeprefix(b"data: "))["streams"]
                spans.append(max(s["bin_s"] * len(s["min"][0]) for s in streams))
            if len(spans) == 60:
                return statistics.median(spans)
    raise AssertionError("the stream of events ended")


def drawn(browser, seconds=2):
    """Frames a second that the page draws: the best of a few stretches, on a machine that is busy."""
    best = 0
    for _ in range(5):
        before, at = frames(browser), time.monotonic()
        time.sleep(seconds)
        best = max(best, (frames(browser) - before) / (time.monotonic() - at))
        if best >= 20:
            break
    return best


def check(browser, station, shots):
    browser.resize(1280, 1000)
    browser.scheme("light")
    browser.open(station.url + "/")

    # By keyboard alone: `e` goes to the form, Tab from field to field.
    browser.wait("the form", lambda: browser.run("return document.getElementById('surface').offsetParent !== null"))
    browser.keys("e")
    browser.wait("the form has the focus", lambda: browser.run("return document.activeElement.id") == "surface")
    # Five trials are proposed; one is enough here.
    browser.run("document.getElementById('trials').value = 1")
    browser.keys("slate" + TAB + TAB + TAB)
    focused = browser.run("return document.activeElement.id")
    assert focused == "enroll", f"Tab leads from the fields to the button, not to {focused!r}"
    outline = browser.run("return getComputedStyle(document.activeElement).outlineStyle")
    assert outline != "none", "what has the focus can be seen"
    browser.keys(ENTER)
    browser.wait("the enrolment", lambda: "slate" in (browser.text("#enrolling-what") or ""))
    browser.wait("the trial that was kept", lambda: "kept as slate" in (browser.text("#enrolled") or ""))
    browser.wait("the library read anew", lambda: "slate" in (browser.text("#surfaces") or ""))

    # Traces come twenty times a second or more, by the signal's own time: a machine that is busy with
    # other things sends and draws some of them late, which is no fault of the page's.
    before, looked = frames(browser), pixels(browser)
    browser.wait("forty frames of traces", lambda: frames(browser) >= before + 40)
    assert pixels(browser) != looked, "the traces move"
    span_s = cadence(station)
    print(f"traces: sent every {span_s * 1e3:.0f} ms, {drawn(browser):.1f} frames a second drawn")
    assert span_s <= 0.05, f"an event of traces brings {span_s} s"

    state = "return document.getElementById('now').dataset.state"
    browser.wait("a name", lambda: browser.run(state) == "nearest" and browser.text("#name") == "slate")
    assert "scan" in browser.text("#answer-label")
    assert browser.run("return document.querySelectorAll('#runners li').length") >= 2
    assert "slate" in browser.text("#announce"), "a screen reader says it"
    shot(browser, shots, "light")

    browser.keys("v")
    browser.wait("`v` changes to spectra", lambda: browser.run(
        "return document.getElementById('view-spectra').ariaPressed") == "true")
    browser.scheme("dark")
    ground = browser.run("return getComputedStyle(document.documentElement).backgroundColor")
    assert max(map(int, re.findall(r"\d+", ground)[:3])) < 64, f"dark: {ground}"
    time.sleep(1)
    shot(browser, shots, "dark")
    browser.keys("v")

    browser.resize(360, 740)
    browser.scheme("light")
    wide = browser.run("return document.documentElement.scrollWidth")
    assert wide <= 360, f"nothing sticks out at 360 px: {wide}"
    time.sleep(0.5)
    shot(browser, shots, "narrow")
    browser.resize(1280, 1000)

    # A label that is refused is said to be, and stays text.
    browser.type("#surface", "<img src=x onerror=alert(1)>")
    browser.click("#enroll")
    browser.wait("a refusal", lambda: "surface" in (browser.text("#problem") or ""))
    assert browser.run("return document.querySelectorAll('main img').length") == 0
    refused = [entry for entry in browser.log("browser") if "/api/v1/enroll" not in entry["message"]]
    assert not refused, f"the console has the refusal alone: {refused}"

    # A page that is loaded anew knows what went before.
    browser.open(station.url + "/")
    rows = lambda: browser.run("return document.querySelectorAll('#scans tr').length")  # noqa: E731
    browser.wait("the history", lambda: rows() >= 1)
    browser.run("""const text = document.getElementById('filter-text'); text.value = 'no scan holds this';
        text.dispatchEvent(new Event('input', { bubbles: true }))""")
    browser.wait("no scan is like that", lambda: rows() == 0 and browser.text("#no-scans") == "No scan is like that.")
    assert "text=no+scan" in browser.run("return document.getElementById('export-csv').href")
    browser.run("""document.getElementById('filter-text').value = '';
        const user = document.getElementById('filter-user'); user.value = user.list.options[0].value;
        user.dispatchEvent(new Event('input', { bubbles: true }))""")
    browser.wait("the scans of one person", lambda: rows() >= 1)
    assert "user=expert" in browser.run("return document.getElementById('export-csv').href")
    assert browser.run("return document.getElementById('filter-user').offsetParent !== null")
    browser.run("document.getElementById('filter-user').value = ''")
    # A shortcut is a key alone; a barcode scanner types faster than anybody.
    state = lambda: browser.run("return document.getElementById('filter-state').value")  # noqa: E731
    browser.run("""const text = document.getElementById('filter-text'); text.value = ''; text.blur();
        text.dispatchEvent(new Event('input', { bubbles: true }))""")
    browser.wait("all scans again", lambda: rows() >= 1)
    browser.run("""for (const key of '4u7u') document.body.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true }))""")
    time.sleep(0.3)
    assert state() == "", "a burst of keys is no shortcut"
    browser.run("document.body.dispatchEvent(new KeyboardEvent('keydown', { key: 'u', bubbles: true }))")
    browser.wait("the shortcut", lambda: state() == "unknown,unsure,unnamed")
    browser.run("document.body.dispatchEvent(new KeyboardEvent('keydown', { key: 'u', bubbles: true }))")
    browser.wait("the shortcut again", lambda: state() == "")
    assert browser.text("#name") not in ("", "—")
    console = browser.log("browser")
    assert not console, f"the console stays empty: {console}"
    # Chromium's own first tab is made of chrome: pages.
    elsewhere = [url for url in requests(browser) if not url.startswith((station.url, "data:", "chrome"))]
    assert not elsewhere, f"nothing is asked of others: {elsewhere}"


def on_stage(check, prepare, **size):
    """Runs `check(browser, station, shots)` on a scene of this size, whose library was prepared by `prepare(surfaced, library, data)`."""
    surfaced, shots = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    with tempfile.TemporaryDirectory() as folder, Browser() as browser:
        library, data = scene(surfaced, Path(folder), **size)
        prepare(surfaced, library, data)
        station = Station(surfaced, library, data)
        try:
            check(browser, station, shots)
        finally:
            station.end()


def shot(browser, shots, name):
    if shots:
        browser.screenshot(Path(shots) / f"{name}.png", whole=True)


def main():
    surfaced, shots = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    with tempfile.TemporaryDirectory() as folder:
        library, data = scene(surfaced, Path(folder))
        station = Station(surfaced, library, data, "--sources", "ac,ir,fr,me,mi2", "--n", "100")
        try:
            with Browser() as browser:
                check(browser, station, shots)
        finally:
            code, lines, said = station.end()
        kept = [line for line in lines if line.get("folder")]
        assert len(kept) == 1 and (library / "slate").is_dir(), f"one trial was kept: {kept}\n{said}"
        assert all(line["lost_samples"] == 0 for line in lines if "lost_samples" in line)
        # 3: the replay was ended in the middle of a scan, which it says.
        assert code == 0 or (code == 3 and "was cut off" in said), f"exit code {code}\n{said}"
    print("the page works")


if __name__ == "__main__":
    main()
