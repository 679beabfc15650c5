#!/usr/bin/env python3
"""The operator's day in headless Chromium: open a scan, correct it, make it a trial, check and edit
the library, and find the history after the daemon was killed.

    tests/browser/review.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

import json
import signal
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from page import Station, run, scene, shot
from webdriver import Browser

# Seconds that each synthetic scan lasts.
DRAG = "1.5"
WIDTHS = (1920, 1280, 360)


def mislabelled(surfaced, folder):
    """A library of two surfaces in which one trial bears the wrong label, and recordings of a third."""
    library, data = scene(surfaced, folder, trials="40", users="0", kept=6, seconds=DRAG)
    right, wrong = sorted(path.name for path in library.iterdir() if path.is_dir())
    run(surfaced, "library", "move", library, f"{right}/expert-06", "--to", wrong)
    return library, data, wrong


def get(station, path):
    with urllib.request.urlopen(station.url + path, timeout=20) as answer:
        return json.load(answer)


def give_past(stage, scans, every_s, lines):
    """Writes a history of scans into a library, one every `every_s` seconds until now. `lines(scan, answer)` gives
    the lines of each; `answer` is one that a station on this stage gives, with the id and time of the past scan."""
    surfaced, library, data = stage
    station = Station(surfaced, library, data)
    try:
        answer = Browser.wait("an answer", lambda: get(station, "/api/v1/scans?limit=1")["scans"])[0]
    finally:
        station.end()
    for added in ("correction", "became", "became_by", "kept"):
        del answer[added]
    folder = library / ".history"
    folder.mkdir(exist_ok=True)
    begin = answer["unix_ms"] - scans * every_s * 1000
    with open(folder / "answers.jsonl", "w") as log:
        for scan in range(1, scans + 1):
            ms = begin + scan * every_s * 1000
            moment = time.strftime("%Y%m%d-%H%M%S", time.gmtime(ms / 1000))
            name = f"{moment}.{ms % 1000:03}-{scan:02}"
            own = {"id": name, "link": f"/#scan={name}", "unix_ms": ms, "scan": scan}
            log.writelines(json.dumps(line) + "\n" for line in lines(scan, {**answer, **own}))


def shots_of(browser, shots, name):
    """Light and dark, wide and narrow; nothing may stick out sideways."""
    for width in WIDTHS:
        browser.resize(width, 1000 if width > 600 else 740)
        for scheme in ("light", "dark"):
            browser.scheme(scheme)
            wide = browser.run("return document.documentElement.scrollWidth")
            assert wide <= width, f"{name}: nothing sticks out at {width} px: {wide}"
            inner = browser.run(
                "return [...document.querySelectorAll('dialog[open]')].map(d => d.scrollWidth - d.clientWidth)")
            assert all(over <= 0 for over in inner), f"{name}: the dialog fits {width} px: {inner}"
            if shots:
                browser.wait("the pictures", lambda: browser.run(
                    "return [...document.images].every(i => i.complete)"))
                browser.screenshot(Path(shots) / f"{name}-{width}-{scheme}.png")
    browser.resize(1280, 1000)
    browser.scheme("light")


def newest(station):
    scans = get(station, "/api/v1/scans?limit=1")["scans"]
    return scans[0] if scans else None


def open_newest(browser, station):
    """Opens the newest scan that is whole, not corrected, and whose signals are kept, by its row; gives it."""
    fresh = lambda scan: scan["kept"] and not scan["spoiled"] and not scan["correction"]
    scan = browser.wait("a scan that is kept", lambda: next(
        filter(fresh, get(station, "/api/v1/scans?limit=5")["scans"]), None))
    row = f"#scans tr[data-id='{scan['id']}'] button"
    browser.wait("its row", lambda: browser.run("return !!document.querySelector(arguments[0])", row))
    browser.run("document.querySelector(arguments[0]).click()", row)
    browser.wait("the scan, opened", lambda: browser.run(
        "return document.getElementById('scan').dataset.shown") == scan["id"])
    return scan


def opens_and_says_why(browser, station, shots):
    scan = open_newest(browser, station)
    count = lambda selector: browser.run("return document.querySelectorAll(arguments[0]).length", selector)
    assert count("#scan-body .says li") >= 2, "what each source says"
    assert count("#scan-body canvas.chart") >= 4, "signals and spectra"
    assert count("#scan-body audio") >= 1, "the sound to play"
    assert count("#scan-body .ranking li") == 2
    pictures = browser.run("return [...document.querySelectorAll('#scan-body img')].map(i => i.alt)")
    assert any("nearest" in alt for alt in pictures) and any("this scan" in alt for alt in pictures), pictures
    browser.wait("the pictures", lambda: browser.run(
        "return [...document.querySelectorAll('#scan-body img')].every(i => i.naturalWidth === 320)"))
    with urllib.request.urlopen(f"{station.url}/api/v1/scans/{scan['id']}/mi2.wav") as sound:
        assert sound.read(4) == b"RIFF" and sound.headers["Content-Type"] == "audio/wav"
    shots_of(browser, shots, "scan")


def correct_and_keep(browser, station):
    """Says that the open scan was slate, and makes it a trial; gives the scan."""
    browser.type("#was", "slate")
    browser.click("#was-other")
    # A scan that was named slate, thanks to the trial kept before, was named right.
    said = lambda: browser.text("#was-now") or ""
    browser.wait("the correction", lambda: "it was slate" in said() or "right" in said())
    browser.click("#keep")
    browser.wait("the trial", lambda: "slate/expert-" in (browser.text("#was-now") or ""))
    browser.keys("\ue00c")
    browser.wait("the dialog closed", lambda: not browser.run("return document.getElementById('scan').open"))


def a_wrong_answer_is_corrected(browser, station, shots):
    """Corrects two scans, and sees the next ones named right."""
    before = newest(station)["scan"]
    correct_and_keep(browser, station)
    browser.wait("another scan", lambda: newest(station)["scan"] > before)
    right = int(open_newest(browser, station)["surface"] == "slate")
    correct_and_keep(browser, station)
    after = newest(station)["scan"]
    slate = lambda: newest(station)["scan"] > after + 1 and newest(station)["surface"] == "slate"
    browser.wait("the next scan named slate", slate)
    browser.wait("the name on the page", lambda: "slate" in browser.text("#name"))
    badges = browser.run("return [...document.querySelectorAll('#scans .badge')].map(b => b.innerText)")
    assert "in the library" in badges, badges
    precision = get(station, "/api/v1/history")["precision"]
    assert sum(p["corrected"] for p in precision) == 2 and sum(p["right"] for p in precision) == right, precision
    shots_of(browser, shots, "page")


def the_library_is_checked_and_mended(browser, station, shots, wrong):
    """Finds the trial with the wrong label, removes it, sees the verdicts change, and takes it back."""
    browser.open_library()
    state = lambda: browser.run("return document.getElementById('shelf').dataset.check")
    browser.wait("the trials", lambda: browser.run("return document.querySelectorAll('#shelf-trials tbody tr').length") > 12)
    browser.click("#check")
    browser.wait("the check", lambda: state() == "done")
    verdicts = "return [...document.querySelectorAll('#shelf-trials .wrong')].map(w => w.closest('tr').dataset.trial)"
    found = browser.run(verdicts)
    mislabelled = next(iter(t for t in found if t.startswith(wrong + "/")), None)
    assert mislabelled, f"the trial with the wrong label is named otherwise: {found}"
    shots_of(browser, shots, "library")
    browser.run("document.querySelector(arguments[0]).click()", f"#shelf-trials tr[data-trial='{mislabelled}'] button:last-child")
    browser.wait("the trial gone", lambda: mislabelled not in browser.run(
        "return [...document.querySelectorAll('#shelf-trials tr')].map(t => t.dataset.trial)"))
    browser.wait("the verdicts anew", lambda: state() == "done" and mislabelled not in browser.run(verdicts))
    assert (Path(station.library) / ".removed" / mislabelled).is_dir(), "it can come back"
    assert "remove" in browser.text("#undo")
    browser.click("#undo")
    browser.wait("the trial back", lambda: (Path(station.library) / mislabelled).is_dir())
    browser.keys("\ue00c")


def a_stalled_device_is_grey(browser, station, shots):
    """Stops the station's process: within a second, no trace looks alive."""
    stalled = "return document.querySelectorAll('.plot:not(.camera)[data-stalled]').length"
    browser.wait("live traces", lambda: browser.run(stalled) == 0)
    station.process.send_signal(signal.SIGSTOP)
    try:
        time.sleep(1)
        assert browser.run(stalled) == browser.run("return document.querySelectorAll('.plot:not(.camera)').length")
        assert "no data for" in browser.text(".plot span")
        if shots:
            browser.screenshot(Path(shots) / "stalled.png")
    finally:
        station.process.send_signal(signal.SIGCONT)
    browser.wait("live traces again", lambda: browser.run(stalled) == 0)


def the_camera_shows_its_region_and_its_light(browser, shots):
    """What a station with a camera says of it, said here by the test: the recordings' are cut already."""
    camera = ".camera[data-source=ca1]"
    text = lambda: browser.text(f"{camera} div") or ""
    browser.wait("a picture", lambda: browser.run(
        "return document.querySelector(arguments[0] + ' img')?.naturalWidth === 320", camera))
    browser.wait("what is compared", lambda: "all of it is compared" in text())
    view = {"source": "ca1", "region": {"left": 0.25, "top": 0, "width": 0.5, "height": 1}, "flash": "on"}
    browser.run("import('/camera.js').then(({ view }) => view(arguments[0]))", view)
    browser.wait("the light", lambda: "flash on" in text() and "inside the frame" in text())
    left, width, whole = browser.run(
        "const [region, view] = ['.region', '.view'].map(s => document.querySelector(arguments[0] + ' ' + s).getBoundingClientRect());"
        "return [(region.left - view.left) / view.width, region.width / view.width, view.width]", camera)
    assert abs(left - 0.25) < 0.03 and abs(width - 0.5) < 0.03 and whole > 50, (left, width, whole)
    shots_of(browser, shots, "camera")
    browser.run("import('/camera.js').then(({ view }) => view(null))")
    browser.wait("the camera as before", lambda: "all of it is compared" in text())
    # Recordings have no whole picture; that the page asked for one is the test's doing.
    browser.log("browser")


def check(browser, station, shots, wrong):
    browser.resize(1280, 1000)
    browser.scheme("light")
    browser.open(station.url + "/")
    opens_and_says_why(browser, station, shots)
    browser.keys("\ue00c")
    the_camera_shows_its_region_and_its_light(browser, shots)
    a_stalled_device_is_grey(browser, station, shots)
    open_newest(browser, station)
    a_wrong_answer_is_corrected(browser, station, shots)
    the_library_is_checked_and_mended(browser, station, shots, wrong)


def main():
    surfaced, shots = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    with tempfile.TemporaryDirectory() as folder, Browser() as browser:
        library, data, wrong = mislabelled(surfaced, Path(folder))
        station = Station(surfaced, library, data)
        station.library = library
        try:
            check(browser, station, shots, wrong)
            before = get(station, "/api/v1/scans?limit=1000")["scans"]
        finally:
            station.process.kill()
            station.process.communicate(timeout=30)
        station = Station(surfaced, library, data)
        try:
            browser.open(station.url + "/")
            rows = lambda: browser.run("return [...document.querySelectorAll('#scans tr')].map(r => r.dataset.id)")
            kept = {scan["id"] for scan in before}
            browser.wait("the history", lambda: kept <= set(rows()))
            badges = browser.run("return [...document.querySelectorAll('#scans .badge')].map(b => b.innerText)")
            assert "it was slate" in badges, f"what was said is remembered: {badges}"
            console = [entry for entry in browser.log("browser") if "ERR_" not in entry["message"]]
            assert not console, f"the console stays empty: {console}"
        finally:
            station.end()
    print("a day can be reviewed")


if __name__ == "__main__":
    main()
