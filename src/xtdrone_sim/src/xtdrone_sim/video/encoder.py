"""H.264 over RTP by the program ffmpeg, which reads raw images from a pipe.

ffmpeg packs the stream by RFC 6184 (packetisation mode 1) and repeats the parameter sets before each key image, so
that a receiver may join at any time. Time stamps are in wall time, like a player's clock, regardless of the speed of
the flight. ffmpeg is a separate program, so that encoding does not hold Python's lock.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import threading
import time

from xtdrone_sim.video.streams import CLOCK, PAYLOAD_TYPE, Stream

MOST_RATE = 30.0
"""Maximum number of images encoded per second of wall time; some images of a faster flight are left out."""

_KEY_INTERVAL = 10  # images from one key image to the next
_PACKET = 1400  # bytes, below the usual MTU
_PATIENCE = 5.0  # s for the program to end


class EncoderError(RuntimeError):
    """The encoder cannot work; the message gives the reason."""


class Encoder:
    """Sends the newest images of one camera.

    Attributes:
        sent: number of images passed to the encoder.
    """

    def __init__(self, stream: Stream) -> None:
        """Start the program.

        Raises:
            EncoderError: there is no ffmpeg.
        """
        if shutil.which("ffmpeg") is None:
            raise EncoderError("video: the program ffmpeg is missing (package ffmpeg)")
        self.sent = 0
        self._stream = stream
        self._newest: bytes | None = None
        self._closed = False
        self._last = -1e9
        self._error = ""
        self._condition = threading.Condition()
        self._process = subprocess.Popen(
            _command(stream), stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        self._thread = threading.Thread(target=self._feed, name=f"video of {stream.camera.topics}", daemon=True)
        self._thread.start()

    def put(self, picture: bytes) -> None:
        """Send an image, rows of RGB; if the encoder is busy, the next image replaces it.

        Raises:
            EncoderError: the program has ended.
        """
        with self._condition:
            if self._error:
                raise EncoderError(f"video of {self._stream.camera.topics}: ffmpeg has ended: {self._error}")
            self._newest = picture
            self._condition.notify()

    def close(self) -> None:
        """End the program."""
        with self._condition:
            self._closed = True
            self._condition.notify()
        self._thread.join(_PATIENCE)
        self._process.kill()
        self._process.wait()

    def _feed(self) -> None:
        assert self._process.stdin is not None
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._closed or self._newest is not None)
                if self._closed:
                    break
                picture, self._newest = self._newest, None
            now = time.monotonic()
            if picture is None or now - self._last < 0.9 / MOST_RATE:
                continue
            self._last = now
            try:
                self._process.stdin.write(picture)
                self._process.stdin.flush()
            except OSError:
                self._fail()
                return
            self.sent += 1
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def _fail(self) -> None:
        assert self._process.stderr is not None
        words = self._process.stderr.read().decode("utf-8", "replace").strip().splitlines()
        with self._condition:
            self._error = words[-1] if words else f"exit status {self._process.wait()}"


def _command(stream: Stream) -> list[str]:
    pinhole = stream.camera.mount.pinhole
    width, height = stream.size
    return [
        *("ffmpeg", "-hide_banner", "-loglevel", "error", "-nostdin"),
        *("-probesize", "32", "-fflags", "nobuffer"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", f"{pinhole.width}x{pinhole.height}"),
        *("-framerate", f"{stream.rate:g}", "-i", "pipe:0", "-an"),
        *("-vf", f"crop={width}:{height}:0:0,settb=1/{CLOCK},setpts=(RTCTIME-RTCSTART)/(TB*1000000)"),
        *(
            "-fps_mode",
            "passthrough",
            "-enc_time_base",
            f"1:{CLOCK}",
            "-c:v",
            "h264",
            "-preset",
            "veryfast",
            "-tune",
            "zerolatency",
        ),
        *("-profile:v", "baseline", "-pix_fmt", "yuv420p", "-g", str(_KEY_INTERVAL), "-threads", "1"),
        *("-b:v", str(stream.bitrate), "-maxrate", str(stream.bitrate), "-bufsize", str(stream.bitrate)),
        *("-bsf:v", "dump_extra=freq=keyframe", "-f", "rtp", "-payload_type", str(PAYLOAD_TYPE)),
        f"rtp://{stream.host}:{stream.port}?pkt_size={_PACKET}",
    ]
