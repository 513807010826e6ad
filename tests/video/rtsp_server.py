"""A camera of the real-time streaming protocol (RFC 2326): as much of a server as a client that plays it asks for."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress

import av
import numpy as np

DESCRIPTION = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nt=0 0\r\nm=video 0 RTP/AVP 32\r\na=control:track\r\n"
)
"""Of MPEG video, whose packets need nothing further said about them."""


def packets_of(images: list[np.ndarray], rate: int = 25) -> list[bytes]:
    """The images as packets of the real-time transport protocol, as FFmpeg sends them."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.settimeout(0.2)
        with av.open(f"rtp://127.0.0.1:{receiver.getsockname()[1]}", "w", format="rtp") as output:
            stream = output.add_stream("mpeg1video", rate=rate)
            stream.height, stream.width = images[0].shape[:2]
            stream.pix_fmt, stream.gop_size, stream.bit_rate = "yuv420p", 4, 8_000_000
            for image in images:
                for packet in stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")):
                    output.mux(packet)
            for packet in stream.encode():
                output.mux(packet)
        packets = []
        with suppress(TimeoutError):
            while True:
                packets.append(receiver.recv(1 << 16))
    return packets


class RtspCamera:
    """Plays the same packets to whoever asks, and hangs up; from connection number ``most`` on nobody is answered."""

    def __init__(self, packets: list[bytes], most: int) -> None:
        self.packets, self.most, self.connections, self.methods = packets, most, 0, []
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.address = f"rtsp://127.0.0.1:{self._socket.getsockname()[1]}/camera"
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self._socket.close()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._socket.accept()
                self.connections += 1
                with connection, suppress(OSError):
                    if self.connections <= self.most:
                        self._answer(connection)

    def _answer(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as lines:
            while line := lines.readline():
                method = line.split()[0].decode()
                headers = {}
                while (line := lines.readline().strip()) and b":" in line:
                    name, _, value = line.decode().partition(":")
                    headers[name.lower()] = value.strip()
                self.methods.append(method)
                answer, body = [f"CSeq: {headers['cseq']}"], ""
                if method == "OPTIONS":
                    answer.append("Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN")
                elif method == "DESCRIBE":
                    body = DESCRIPTION
                    answer += ["Content-Type: application/sdp", f"Content-Length: {len(body)}"]
                else:
                    answer.append("Session: 1")
                if method == "SETUP":
                    assert "interleaved=0-1" in headers["transport"], "over TCP"
                    answer.append("Transport: RTP/AVP/TCP;unicast;interleaved=0-1")
                connection.sendall("\r\n".join(["RTSP/1.0 200 OK", *answer, "", body]).encode())
                if method == "PLAY":
                    for packet in self.packets:
                        connection.sendall(b"$\0" + len(packet).to_bytes(2, "big") + packet)
                        time.sleep(0.002)
                    return
