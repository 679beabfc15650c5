#!/usr/bin/env python3
"""The page of a fleet in headless Chromium: three stations appear with their answers, one is killed, what
needs somebody can be shown alone, and stations that misbehave harm nobody.

    tests/browser/fleet.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs mosquitto, chromium and chromedriver (Debian: mosquitto mosquitto-clients chromium chromium-driver), and axe-core
(`pip install axe-core-python`).
"""

import importlib.machinery
import importlib.util
import json
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from review import shots_of
from webdriver import Browser

TOOL = Path(__file__).resolve().parents[2] / "tools" / "many-stations"


def load(path):
    loader = importlib.machinery.SourceFileLoader("many_stations", str(path))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("many_stations", loader))
    loader.exec_module(module)
    return module


def cards(browser):
    return browser.run("""return [...document.querySelectorAll('#stations > li')].map(
        card => [card.querySelector('h3').innerText, card.dataset.state, card.querySelector('.last')?.innerText ?? ''])""")


def check(browser, fleet, stations, shots):
    browser.open(fleet.url)
    browser.wait("three stations with an answer", lambda: sum(bool(last) for _, _, last in cards(browser)) == 3)
    assert [name.split()[0] for name, _, _ in cards(browser)] == ["press-0", "press-1", "press-2"], cards(browser)
    links = browser.run("return [...document.querySelectorAll('#stations h3 a')].map(a => a.href)")
    assert links == [station.url + "/" for station in stations], links
    for scheme in ("dark", "light"):
        browser.scheme(scheme)
        browser.accessible(f"fleet, {scheme}")
    shots_of(browser, shots, "fleet")
    stations[1].process.kill()
    browser.wait("the one that was killed", lambda: [state == "offline" for _, state, _ in cards(browser)] == [False, True, False])
    browser.click("#trouble-only")
    names = lambda: [name.split()[0] for name, _, _ in cards(browser)]  # noqa: E731
    browser.wait("it stays", lambda: "press-1" in names())
    shown = json.loads(browser.run("""return JSON.stringify([...document.querySelectorAll('#sums div')].map(
        group => [group.querySelector('dt').innerText, group.querySelector('dd').innerText]))"""))
    assert ["offline", "1"] in shown and ["online", "2"] in shown, shown
    silent(browser, fleet, shots)
    errors = [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"]
    assert not errors, errors


def silent(browser, fleet, shots):
    """A fleet's program that is suspended leaves no answer on the screen, and says since when."""
    browser.click("#trouble-only")
    fleet.process.send_signal(signal.SIGSTOP)
    try:
        browser.wait("grey cards", lambda: all(state == "lost" for _, state, _ in cards(browser)))
        assert re.fullmatch(r"Not connected since \d\d:\d\d", browser.text("#link")), browser.text("#link")
        answers = [last for _, _, last in cards(browser)]
        assert all(last.startswith("last scan, ") for last in answers), answers
        shots_of(browser, shots, "fleet-silent")
    finally:
        fleet.process.send_signal(signal.SIGCONT)
    browser.wait("live cards again", lambda: any(state != "lost" for _, state, _ in cards(browser)))


def answer(station, unix_ms, **more):
    return json.dumps({"station": station, "id": f"x-{unix_ms}", "unix_ms": unix_ms, "state": "named", "surface": "oak",
                       "confidence": 0.9, "sequence": 1, **more})


def misbehave(browser, many, fleet, broker, shots):
    """Stations that misbehave, each in its way, harm neither the others nor the page."""
    def publish(topic, text):
        command = ["mosquitto_pub", "-p", str(broker.port), "-r", "-q", "1", "-s", "-t", f"surfaced/{topic}"]
        subprocess.run(command, input=text, text=True, check=True)

    now = round(time.time() * 1000)
    with socket.create_server(("127.0.0.1", 0)) as silent_page:
        slow = {"state": "online", "page": f"http://127.0.0.1:{silent_page.getsockname()[1]}", "sequence": 9}
        elsewhere = {"state": "online", "page": "http://169.254.169.254", "sequence": 9}
        publish("a-slow/state", json.dumps(slow))
        publish("elsewhere/state", json.dumps(elsewhere))
        publish("large/answer", answer("large", now, note="x" * (300 << 10)))
        publish("odd/state", json.dumps({"state": "online", "devices": 7}))
        publish("odd/answer", answer("odd", now, confidence="much"))
        publish("ahead/answer", answer("ahead", now + 3 * 3_600_000))
        state = browser.wait("three messages are passed over", lambda: (
            state := fleet.state())["passed_over"]["messages"] == 3 and state)
        assert state["broker"]["problem"] is None, state["broker"]
        shown = lambda: browser.text("#stations")  # noqa: E731
        browser.wait("a clock that is ahead", lambda: "clock is ahead by 180 minutes" in shown())
        browser.wait("a page that is not allowed", lambda: "--pages 169.254.169.254" in shown())
        assert "3 messages passed over" in browser.text("#problem"), browser.text("#problem")
        assert browser.text("#link") == "connected"
        # Of an answer from the future, the time of its arrival counts, and a later answer is newer.
        publish("late/answer", answer("late", round(time.time() * 1000) + 2000))
        newest = lambda: json.loads(many.get(fleet.url, "/api/v1/scans"))["scans"]  # noqa: E731
        browser.wait("the later answer is the newest", lambda: newest()[0]["station"] == "late")
        ahead = next(scan for scan in newest() if scan["station"] == "ahead")
        assert ahead["unix_ms"] < now + 600_000 and ahead["said_unix_ms"] == now + 3 * 3_600_000, ahead
        shots_of(browser, shots, "fleet-misbehaving")


def main():
    surfaced, shots = str(Path(sys.argv[1]).resolve()), sys.argv[2] if len(sys.argv) > 2 else None
    many = load(TOOL)
    with tempfile.TemporaryDirectory() as place, Browser() as browser:
        folder = Path(place)
        data = many.make_data(surfaced, folder, 60)
        broker = many.Mosquitto(folder)
        fleet = many.Fleet(surfaced, broker.port, folder / "cache")
        stations = [many.Station(surfaced, folder, f"press-{at}", broker.port, data) for at in range(3)]
        try:
            for station in stations:
                station.url = many.serving(station.process)
            check(browser, fleet, stations, shots)
            misbehave(browser, many, fleet, broker, shots)
        finally:
            for station in stations:
                station.end()
            fleet.end()
            broker.end()
    print("the fleet's page shows its stations")


if __name__ == "__main__":
    main()
