"""A stylus on a pseudo-terminal: noise on its seven channels in real time, as its firmware sends it,
and scans that are played from recordings.

The format is that of `firmware/wire`. Python's standard library and nothing else.
"""

import array
import math
import os
import random
import struct
import threading
import time
import tty
import zlib

RATE_HZ = 10_000
CHANNELS = ["acc_x", "acc_y", "acc_z", "fsr_1", "fsr_2", "ir", "metal"]
# Samples of a frame.
FRAME = 32
HELLO, SAMPLES, STATUS, COMMAND = 0x01, 0x02, 0x03, 0x10
START, STOP = 1, 2


def stuffed(data):
    """COBS, without the delimiter."""
    out = bytearray()
    for part in data.split(b"\0"):
        while len(part) >= 254:
            out += b"\xff" + part[:254]
            part = part[254:]
        out += bytes([len(part) + 1]) + part
    return bytes(out)


def unstuffed(data):
    out = bytearray()
    while data:
        length, part = data[0], data[1:data[0]]
        out += part
        data = data[length:]
        if data and length < 255:
            out.append(0)
    return bytes(out)


def frame(kind, body):
    plain = bytes([1, kind]) + body
    return stuffed(plain + struct.pack("<I", zlib.crc32(plain))) + b"\0"


def text(value):
    return bytes([len(value)]) + value.encode()


def series(path):
    """The samples of a 16-bit WAV file."""
    data = path.read_bytes()
    begin = data.index(b"data") + 8
    return array.array("h", data[begin:begin + int.from_bytes(data[begin - 4:begin], "little")])


def scan_of(trial, seconds=60, change=lambda sample: sample):
    """A tap and the drag of a recorded trial, at most so long, as frames of the seven channels; each
    sample of the drag is changed."""
    dice = random.Random(2)
    ac, fr, ir, me = (series(trial / f"{source}.wav") for source in ("ac", "fr", "ir", "me"))
    count = min(len(ir), int(seconds * RATE_HZ))
    gravity = [sum(ac[c:3 * count:3]) // count for c in range(3)]

    def hold(seconds, swing=0):
        for i in range(int(seconds * RATE_HZ)):
            hit = int(swing * math.exp(-i / 100) * math.sin(i * 0.1885))
            pressed = 3276 if swing else 0
            yield [g + hit + dice.randint(-3, 3) for g in gravity] + [
                100 + pressed + dice.randint(-9, 9), 100 + pressed + dice.randint(-9, 9), 100 + dice.randint(-9, 9), 0]

    frames = [*hold(0.7), *hold(0.03, 9800), *hold(0.3)]
    for i in range(count):
        frames.append(change([*ac[3 * i:3 * i + 3], *fr[2 * i:2 * i + 2], ir[i], me[i]]))
    frames += hold(0.7)
    clamped = (max(-32768, min(32767, x)) for frame in frames for x in frame)
    return struct.pack(f"<{7 * len(frames)}h", *clamped)


class Stylus:
    """Plugged in from the start: `link` leads to it until it is unplugged."""

    def __init__(self, link, noise=300):
        self.line, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.line, False)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self.slave))
        self.link = link
        dice = random.Random(1)
        # A second of noise, again and again.
        self.noise = struct.pack(f"<{RATE_HZ * 7}h", *(dice.randint(-noise, noise) for _ in range(RATE_HZ * 7)))
        self.tape = b""
        self.sampling, self.next, self.seen = False, 0, b""
        self.unplugged = threading.Event()
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def put(self, data):
        while data and not self.unplugged.is_set():
            try:
                data = data[os.write(self.line, data):]
            except BlockingIOError:
                time.sleep(0.001)

    def hello(self):
        scale = {"metal": 1 / 32767}
        channels = b"".join(struct.pack("<f", scale.get(name, 1.0)) + text(name) + text("") for name in CHANNELS)
        self.put(frame(HELLO, bytes([0, 1, 0]) + struct.pack("<I", RATE_HZ) + text("T1")
                       + bytes([len(CHANNELS)]) + channels))

    def obey(self):
        try:
            self.seen += os.read(self.line, 256)
        except BlockingIOError:
            return
        *frames, self.seen = self.seen.split(b"\0")
        for plain in filter(None, map(unstuffed, frames)):
            if plain[1] != COMMAND:
                continue
            if plain[2] == STOP:
                self.sampling = False
            else:
                self.hello()
            if plain[2] == START and not self.sampling:
                self.sampling, self.next, self.begin = True, 0, time.monotonic()
            self.put(frame(STATUS, struct.pack("<QIIhB", self.next, 0, 0, -32768, int(self.sampling))))

    def run(self):
        while not self.unplugged.is_set():
            self.obey()
            due = (time.monotonic() - self.begin) * RATE_HZ if self.sampling else 0
            while self.sampling and self.next + FRAME <= due and not self.unplugged.is_set():
                at = self.next % (RATE_HZ - FRAME) * 14
                head = struct.pack("<QBB", self.next, len(CHANNELS), FRAME)
                played, self.tape = self.tape[:FRAME * 14], self.tape[FRAME * 14:]
                self.put(frame(SAMPLES, head + played + self.noise[at + len(played):at + FRAME * 14]))
                self.next += FRAME
            time.sleep(0.005)

    def play(self, scan):
        """Samples this from now on."""
        self.tape = scan

    def unplug(self):
        self.unplugged.set()
        self.thread.join()
        self.link.unlink(missing_ok=True)
        os.close(self.line)
        os.close(self.slave)
