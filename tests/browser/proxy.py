#!/usr/bin/env python3
"""The page in a folder of a reverse proxy, which takes the folder off and asks for a host of its own.

    tests/browser/proxy.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

import http.client
import os
import sys
import tempfile
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from page import Live, requests, scene
from webdriver import Browser

FOLDER = "/press-3"
TOKEN = "0123456789abcdef"


class Proxy(BaseHTTPRequestHandler):
    def do_GET(self):
        if not self.path.startswith(FOLDER + "/"):
            self.send_error(404)
            return
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        hidden = ("host", "connection", "accept-encoding")
        headers = {name: value for name, value in self.headers.items() if name.lower() not in hidden}
        station = http.client.HTTPConnection(self.server.station)
        station.request(self.command, self.path.removeprefix(FOLDER), body, headers)
        answer = station.getresponse()
        self.send_response_only(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in ("transfer-encoding", "connection"):
                self.send_header(name, value)
        self.end_headers()
        try:
            while data := answer.read1(65536):
                self.wfile.write(data)
                self.wfile.flush()
        except OSError:
            pass  # the browser has closed a stream
        station.close()

    do_POST = do_GET

    def log_message(self, *_):
        pass


def check(browser, url, shots):
    browser.open(url + "/")
    browser.wait("the form for the token", lambda: browser.run("return !!document.querySelector('input[name=token]')"))
    browser.run(f"document.querySelector('input[name=token]').value = '{TOKEN}'; document.forms[0].submit()")
    link = lambda: browser.run("return document.body.dataset.link ?? document.getElementById('link')?.dataset.state")
    browser.wait("the page is connected", lambda: link() == "connected")
    assert browser.run("return location.href") == url + "/"
    browser.wait("a library", lambda: (browser.text("#surfaces") or "") != "")
    sent = "return fetch('api/v1/start', { method: 'POST' }).then((answer) => answer.status)"
    assert browser.run(sent) == 202, "its own pages may send commands"
    for scheme, width in [("light", 1280), ("dark", 360)]:
        browser.scheme(scheme)
        browser.resize(width, 1000)
        if shots:
            browser.screenshot(shots / f"proxy-{scheme}-{width}.png")
    browser.run("document.querySelector('a[href*=kiosk]').click()")
    browser.wait("the kiosk", lambda: browser.run("return document.body.dataset.view") == "kiosk")
    assert browser.run("return location.href") == url + "/?view=kiosk"
    browser.wait("the kiosk is connected", lambda: link() == "connected")
    elsewhere = [to for to in requests(browser) if to.startswith("http") and not to.startswith(url + "/")]
    assert not elsewhere, f"all is in the folder, but for {elsewhere}"
    errors = [entry["message"] for entry in browser.log("browser") if entry["level"] == "SEVERE" and " 401 " not in entry["message"]]
    assert not errors, errors


def main():
    surfaced = sys.argv[1]
    shots = Path(sys.argv[2]) if len(sys.argv) > 2 else None
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        library, _ = scene(surfaced, folder)
        proxy = ThreadingHTTPServer(("127.0.0.1", 0), Proxy)
        proxy.daemon_threads = True
        url = f"http://127.0.0.1:{proxy.server_port}{FOLDER}"
        config = folder / "station.toml"
        config.write_text(f'format = 1\n[page]\npublic_address = "{url}"\n')
        os.environ["SURFACED_TOKEN"] = TOKEN
        station = Live(surfaced, "--library", library, "--config", config)
        proxy.station = station.url.removeprefix("http://")
        threading.Thread(target=proxy.serve_forever, daemon=True).start()
        try:
            with Browser() as browser:
                check(browser, url, shots)
        finally:
            station.end()
    print("the page works in a folder of a reverse proxy")


if __name__ == "__main__":
    main()
