"""The first pass over a log: all that is small, and whether the rig fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.messages import ImageMessage, MarkerMessage
from runners.sensors.log.motion import JointHistory, Movements
from runners.sensors.log.probe_windows import ProbeWindow, marked_windows, timed_windows, whole_log
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.transforms import TransformTree
from runners.sensors.log_checks import ScannedLog, named_topics, require_topics, transform_topics
from runners.sensors.log_scan import LogScan
from runners.sensors.pad import membrane_reference
from runners.sensors.rig import Rig
from runners.sensors.session_report import LogWarnings

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class FirstPass:
    """What is known of a log before its images are read.

    transform_times (T,): nanoseconds, ascending. cameras, references: by the names of sensors, the
    latter (H, W) in metres of the untouched membranes of pads. bulky: topics for the second pass.
    """

    tree: TransformTree
    transform_times: IntArray
    joints: JointHistory
    clocks: ClockCorrection
    windows: list[ProbeWindow]
    cameras: dict[str, PinholeCamera]
    references: dict[str, FloatArray]
    bulky: tuple[str, ...]


def read_first_pass(
    log: RawLog, rig: Rig, joint_names: Sequence[str], warnings: LogWarnings, progress: Progress
) -> FirstPass:
    """Look through a log. joint_names: of the joints that move the hand.

    Raises SessionError if topics, camera infos or transforms are missing, or depths are no depths.
    """
    require_topics(log, rig)
    scan = LogScan(rig, joint_names)
    topics = {*named_topics(rig), *transform_topics(log)}
    scan.read(log, topics, progress)
    clocks = scan.clocks.correction()
    moving = Movements(rig, joint_names)
    if scan.moving.differs(clocks):
        again = {topic for topic in topics if topic in scan.moving.topics}
        for received in log.messages(again, progress=progress):
            moving.add(received, clocks.time(received))
    else:
        moving = scan.moving
    for text in (*log.warnings, *clocks.warnings):
        warnings.warn(text)
    for text, count in moving.tree.faults.items():
        warnings.warn(text, count)
    scanned = ScannedLog(log, scan, moving, clocks, warnings)
    scanned.check_sensors()
    windows = _windows(scanned)
    cameras = scanned.cameras()
    return FirstPass(
        tree=moving.tree,
        transform_times=moving.times(),
        joints=moving.joints,
        clocks=clocks,
        windows=windows,
        cameras=cameras,
        references=_references(scanned, cameras, windows[0].begin),
        bulky=tuple(scan.message_times),
    )


def _windows(scanned: ScannedLog) -> list[ProbeWindow]:
    """The probes of the log; all of it is one without markers."""
    rig, clocks, warnings = scanned.rig, scanned.clocks, scanned.warnings
    begin, times = scanned.log.begin + clocks.typical, scanned.times.values()
    first = min([begin, *(int(topic[0]) for topic in times)])
    last = max([scanned.log.end + clocks.typical, *(int(topic[-1]) for topic in times)])
    if rig.probes is not None:
        windows = timed_windows(rig.probes, begin, last, warnings)
        return windows or whole_log(first, last)
    if rig.markers:
        markers = [
            (clocks.time(received), received.content.text)
            for received in scanned.scan.markers
            if isinstance(received.content, MarkerMessage)
        ]
        windows = marked_windows(markers, first, last, warnings)
        if windows:
            return windows
        warnings.warn(f"topic {rig.markers} marks no probe: the whole log is one")
    return whole_log(first, last)


def _references(
    scanned: ScannedLog, cameras: dict[str, PinholeCamera], first_begin: int
) -> dict[str, FloatArray]:
    """Depth images of the untouched membranes, by the names of pads.

    first_begin: time of the first probe, nanoseconds.
    """
    references = {}
    for pad in scanned.rig.bubbles:
        camera, first = cameras[pad.name], scanned.scan.first_images[pad.depth]
        size = (camera.height, camera.width)
        fitting = [
            (scanned.clocks.time(received), received.content.values)
            for received in first
            if isinstance(received.content, ImageMessage) and received.content.values.shape == size
        ]
        untouched = [values for time, values in fitting if time < first_begin]
        if pad.reference is None and pad.kind == "depth" and not untouched:
            untouched = [values for _, values in fitting]
            scanned.warnings.warn(
                f"{pad.name}: no image before the first probe; its reference is made of the first "
                f"{len(untouched)} of the probe"
            )
        references[pad.name] = membrane_reference(pad, untouched, camera, scanned.log.path.parent)
    return references
