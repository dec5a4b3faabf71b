"""Writes a recording: MCAP with one channel per key and one per view (see `views`).

`log_time` is the simulated time of sending, in nanoseconds from `time_zero_s`. That is in the
metadata: 0 or, if the recording began before simulated time 0, a whole negative number of seconds.
`publish_time` is the message's stamp on the same scale, or `log_time` if the stamp is not finite.

`flush` closes the chunk and hands it to the kernel, where it survives a SIGKILL of this process.
`bag_reader` and other readers of MCAP can read a file without its end.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.recording import foxglove as fg
from rampart.actors.recording.message_form import Forms, Recorded, plain_schema
from rampart.actors.recording.run_documents import Documents
from rampart.actors.recording.views import View, Views, encode
from rampart.actors.system.topics import find_topic, own_topics

PROFILE = "rampart"
RUN = "rampart.run"
END = "rampart.end"
"""Names of the metadata records about the run, and about the end of the recording."""

KEY = "key"
"""Channel metadata with the full key; only channels of the bus have it."""

_MAX_NS = (1 << 64) - 1

RESERVE_BYTES = 256 << 20
"""Space of a disk that is left for checkpoints and reports: at most so much, or a twentieth."""

_LATE = 1024
"""Most missing messages that are expected to come late."""


class BagError(Exception):
    """A recording cannot be written or read; the text is one line for the user."""


def check_target(path: Path, *, overwrite: bool) -> None:
    """Check before a run that a recording can be written at a path.

    Raises:
        BagError: the file exists, or cannot be written.
    """
    open_target(path, overwrite=overwrite, probe=True).close()


def open_target(path: Path, *, overwrite: bool, probe: bool = False) -> BinaryIO:
    """Open the file of a new recording; `probe` leaves no file behind.

    Raises:
        BagError: the file exists, or cannot be written.
    """
    existed = path.exists()
    if existed and not overwrite:
        raise BagError(f"{path}: exists already; choose another name, or --overwrite")
    try:
        file = path.open("ab" if probe else "wb" if overwrite else "xb")
        if probe and not existed:
            path.unlink()
    except FileNotFoundError:
        raise BagError(f"{path}: cannot be written: there is no such directory") from None
    except OSError as error:
        raise BagError(f"{path}: cannot be written: {error.strerror or error}") from None
    return file


def check_reserve(file: int | Path) -> None:
    """Check that a disk has more than `RESERVE_BYTES` free.

    Args:
        file: a file or folder on it, as descriptor or path.

    Raises:
        OSError: it has not.
    """
    disk = os.statvfs(file)
    reserve = min(RESERVE_BYTES, disk.f_blocks * disk.f_frsize // 20)
    if disk.f_bavail * disk.f_frsize < reserve:
        raise OSError(errno.ENOSPC, f"less than {reserve >> 20} MB are free on its disk")


@contextlib.contextmanager
def complete(path: Path) -> Iterator[None]:
    """Delete a new file or folder if writing it fails.

    Raises:
        BagError: it cannot be written.
    """
    try:
        yield
    except BaseException as error:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        elif path.is_file():  # not a device
            path.unlink()
        if isinstance(error, OSError):
            raise BagError(f"{path}: {error.strerror or error}") from None
        raise


class SequenceGaps:
    """Counts lost messages by their sequence numbers, which have no gaps. Pure.

    Args:
        from_start: whether the recording has the first message of every node; otherwise only
            incarnations that begin later start with their first one.
    """

    def __init__(self, *, from_start: bool = False) -> None:
        self._from_start = from_start
        self._first: dict[str, int] = {}
        self._last: dict[tuple[str, int], int] = {}
        self._lost = Counter[str]()
        self._missing: Remembered[tuple[str, int, int], None] = Remembered(_LATE)

    def add(self, header: Header) -> None:
        """Count one message; copies have the same number.

        A more urgent message can overtake one from another host, which is late and not lost.
        """
        process = (header.source, header.incarnation)
        last = self._last.get(process)
        if last is None:
            first = self._first.setdefault(header.source, header.incarnation)
            new = self._from_start or header.incarnation > first
            last = 0 if new else header.sequence - 1
        if header.sequence > last + 1:
            self._lost[header.source] += header.sequence - last - 1
            for number in range(max(last + 1, header.sequence - _LATE), header.sequence):
                self._missing[*process, number] = None
        elif (late := (*process, header.sequence)) in self._missing:
            del self._missing[late]
            self._lost[header.source] -= 1
        self._last[process] = max(last, header.sequence)

    def lost(self) -> dict[str, int]:
        """Return source → number of messages that are not in the recording."""
        return {source: count for source, count in self._lost.items() if count}


class BagWriter:
    """One recording, from the first message to the last.

    Args:
        file: open file, closed at the end.
        documents: description of the run.
        time_zero_s: simulated time at `log_time` 0.
        begin_s: simulated time at which the recording begins; that of `time_zero_s` if None.
        views: translation for viewers; None writes none.
        wants: returns whether a full key is recorded.
        from_start: whether it begins with the first message of every node.
    """

    def __init__(self, file: BinaryIO, documents: Documents, *, time_zero_s: float = 0.0,
                 begin_s: float | None = None, views: Views | None = None,
                 wants: Callable[[str], bool] = lambda _key: True,
                 from_start: bool = False) -> None:
        self.messages = 0
        self.garbage = 0
        self.untranslated = 0
        self.gaps = SequenceGaps(from_start=from_start)
        self._file = file
        self._zero_s = time_zero_s
        self._forms = Forms(documents.known.topics)
        self._own: tuple[Topic[Any], ...] = ()
        with contextlib.suppress(ValueError):  # an actor whose module is missing
            self._own = own_topics(documents.known.system)
        self._views = views
        self._wants = wants
        self._schemas: dict[Any, int] = {}
        self._channels: dict[str, int | None] = {}
        self._view_channels: dict[str, int] = {}
        from mcap.writer import CompressionType, Writer  # noqa: PLC0415 few runs are recorded

        self._writer = Writer(file, compression=CompressionType.LZ4)
        self._writer.start(PROFILE, f"rampart {documents.run['rampart_version']}")
        self._writer.add_metadata(RUN, {**documents.run, "time_zero_s": f"{time_zero_s:g}"})
        for name, media_type, data in documents.files:
            self._writer.add_attachment(0, 0, name, media_type, data)
        if views is not None:
            begin_ns = 0 if begin_s is None else self._ns(begin_s)
            self._show(views, views.start(begin_ns), begin_ns)
        self.flush()

    def take(self, at_s: float, key: str, payload: bytes) -> None:
        """Add a message.

        Args:
            at_s: simulated time of sending.
            key: full key.
            payload: bytes that were sent.

        Raises:
            OSError: the file cannot be written.
        """
        form = self._forms.of(key)
        text, header, body = form.recorded(payload)
        if header is not None:
            self.gaps.add(header)
        if key not in self._channels:
            self._channels[key] = self._channel(key, form.topic) if self._wants(key) else None
        number = self._channels[key]
        if number is None:
            return
        log_ns = stamp_ns = self._ns(at_s)
        if header is None:
            self.garbage += not form.is_foreign
        elif math.isfinite(header.stamp):
            stamp_ns = self._ns(header.stamp)
        sequence = header.sequence & 0xFFFFFFFF if header else 0
        self._writer.add_message(number, log_ns, text, stamp_ns, sequence)
        self.messages += 1
        if self._views is None or header is None or form.topic is None:
            return
        try:
            self._show(self._views, self._views.of(form.topic, key, header, body, log_ns), log_ns)
        except (ValueError, TypeError, OverflowError):  # the message itself is recorded
            self.untranslated += 1

    def flush(self) -> None:
        """Close the chunk and hand everything to the kernel, which keeps it if this process dies.

        Raises:
            OSError: the file cannot be written, or only `RESERVE_BYTES` of the disk are free.
        """
        self._writer.flush()
        check_reserve(self._file.fileno())

    def close(self, end: Mapping[str, str] | None = None) -> None:
        """Write counts and `end` as metadata, and close the file.

        Raises:
            OSError: the file cannot be written.
        """
        self._writer.add_metadata(END, {
            "messages": str(self.messages), "garbage": str(self.garbage),
            "lost": json.dumps(self.gaps.lost(), sort_keys=True),
            "untranslated": str(self.untranslated), **(end or {})})
        self._writer.finish()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, after an error."""
        with contextlib.suppress(OSError):
            self._file.close()

    # -- channels -------------------------------------------------------------------------------

    def _channel(self, key: str, topic: Topic[Any] | None) -> int:
        name = key.removeprefix(f"{ROOT}/")
        topic = topic or find_topic(name, self._own)
        described, schema = {KEY: key}, 0
        if topic is not None:
            schema = self._schema(f"rampart.{topic.type.__name__}", Recorded[topic.type])  # type: ignore[name-defined]
            described |= {"qos": topic.qos.value, "rate_hz": f"{topic.rate_hz:g}",
                          "frame": topic.frame, "about": topic.doc}
        return self._writer.register_channel(name, "json", schema, described)

    def _schema(self, name: str, kind: Any) -> int:
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(
                name, "jsonschema", plain_schema(kind))
        return self._schemas[kind]

    def _show(self, views: Views, found: list[View], log_ns: int) -> None:
        for name, view in found:
            if name not in self._view_channels:
                kind = views.channels[name]
                self._view_channels[name] = self._writer.register_channel(
                    name, "json", self._schema(fg.schema_name(kind), kind))
            self._writer.add_message(self._view_channels[name], log_ns, encode(view), log_ns)

    def _ns(self, at_s: float) -> int:
        seconds = (at_s - self._zero_s) if math.isfinite(at_s) else 0.0
        return round(min(max(0.0, seconds * 1e9), _MAX_NS))
