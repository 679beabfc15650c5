#!/usr/bin/env python3
"""A station that is not heard leaves no answer on the screen, in headless Chromium: its program is
suspended, the network swallows its data, and it ends. An answer that grows old fades.

    tests/browser/silence.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver), and axe-core (`pip install
axe-core-python`).
"""

import re
import signal
import socket
import sys
import tempfile
import threading
import time
from pathlib import Path

from page import Live
from states import STATION, Stage, prepared
from stylus import Stylus, scan_of
from webdriver import Browser

SINCE = r"Not connected since \d\d:\d\d"


class Proxy:
    """Passes connections on, until it swallows whatever comes, in either direction and on new ones too."""

    def __init__(self, url):
        self.to = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        self.passes = threading.Event()
        self.passes.set()
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self.socket.getsockname()[1]}"
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self):
        while True:
            client, _ = self.socket.accept()
            try:
                station = socket.create_connection(self.to)
            except OSError:
                client.close()
                continue
            for ends in ((client, station), (station, client)):
                threading.Thread(target=self.pump, args=ends, daemon=True).start()

    def pump(self, source, sink):
        is_dead = False
        try:
            while data := source.recv(65536):
                # Bytes of a pulled cable never arrive, and nor do later ones; the connection stays open.
                is_dead = is_dead or not self.passes.is_set()
                if not is_dead:
                    sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            pass


def shows_nothing_present(stage, name):
    """The card is grey and says since when; the name is gone, and its scan has its time."""
    browser = stage.browser
    begin = time.monotonic()
    stage.until("offline")
    print(f"{name}: grey after {time.monotonic() - begin:.1f} s")
    assert re.fullmatch(SINCE, browser.text("#word")), browser.text("#word")
    assert browser.text("#name") == "", browser.text("#now")
    assert re.fullmatch(r"last scan, \d\d:\d\d", browser.text("#at")), browser.text("#at")
    assert "grayscale" in browser.run("return getComputedStyle(document.querySelector('main')).filter")
    for scheme in ("dark", "light"):
        browser.scheme(scheme)
        browser.accessible(f"{name}, {scheme}")
    stage.seen(name)


def main():
    surfaced, shots = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    with tempfile.TemporaryDirectory() as folder, Browser() as browser:
        folder = Path(folder)
        library, surfaces, _, played = prepared(surfaced, folder)
        trial = played[surfaces[0]][0]
        config, link = folder / "station.toml", folder / "stylus"
        config.write_text(STATION)
        stylus = Stylus(link, noise=3)
        start = lambda: Live(surfaced, "--library", library, "--config", config, "--stylus", link)  # noqa: E731
        station = start()
        stage = Stage(browser, station, stylus, shots)
        proxy = Proxy(station.url)
        try:
            browser.open(proxy.url + "/")
            browser.wait("a station that is ready", lambda: browser.text("#word") == "Ready")
            assert re.search(r"times: (\S+, UTC[+−]\d\d:\d\d|UTC)\b", browser.text("footer")), browser.text("footer")
            stage.play(scan_of(trial))
            answered = stage.state()
            assert answered not in ("idle", "offline"), answered
            assert re.fullmatch(r"at \d\d:\d\d:\d\d", browser.text("#at")), browser.text("#at")

            for view in ("", "?view=kiosk"):
                browser.open(f"{proxy.url}/{view}")
                stage.until(answered)
                station.process.send_signal(signal.SIGSTOP)
                try:
                    shows_nothing_present(stage, f"suspended{view[-5:]}")
                finally:
                    station.process.send_signal(signal.SIGCONT)
                stage.until(answered)

                proxy.passes.clear()
                shows_nothing_present(stage, f"swallowed{view[-5:]}")
                # New connections pass; the old ones stay dead for good.
                proxy.passes.set()
                stage.until(answered)

            browser.log("browser")
            station.end()
            shows_nothing_present(stage, "ended")

            config.write_text(STATION.replace("stale_after_s = 600", "stale_after_s = 5"))
            stylus.unplug()
            stylus = stage.stylus = Stylus(link, noise=3)
            station = stage.station = start()
            browser.open(station.url + "/?view=kiosk")
            browser.wait("a station that is ready again", lambda: browser.text("#word") == "Ready")
            stylus.play(scan_of(trial))
            stage.until(answered)
            stage.until("idle")
            assert browser.text("#name") == "tap, then drag", browser.text("#now")
            assert re.fullmatch(r"last scan, \d\d:\d\d", browser.text("#at")), browser.text("#at")
            assert browser.run("return document.documentElement.scrollHeight <= innerHeight + 1"), "all of it is on the screen"
            stage.seen("stale")
        finally:
            stage.stylus.unplug()
            station.process.kill()
    print("nothing stale is shown")


if __name__ == "__main__":
    main()
