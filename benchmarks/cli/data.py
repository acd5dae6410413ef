"""`sideslip replay`, `identify`, `inspect`, of recorded drives, and `lane`, of pictures and films.

cv2 is imported when a command needs it, after the limit on a picture's pixels is set.
"""

import math
import os
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from typer import Exit

from ...envs.io import read_document, write_atomic, write_document
from ...envs.numerics import require_extra
from ..harness.parallel import use_shared_bar
from ..report.tables import print_suite
from . import common
from .common import File, Text, Texts, register, take, take_argument

if TYPE_CHECKING:
    from ...envs.sensors.camera.images import Film, Image, Pinhole
    from ...envs.sensors.camera.lane_finder import Lane, LaneFinder
    from ...estimators.wires import SignalCalibration

_MAX_TRIES = 60  # frames in which a lane is looked for that shows how the camera is mounted
_MAX_PIXELS = 2**26  # of a picture; a small file may hold many more
_console = Console(soft_wrap=True, highlight=False)


def _read_wires(
    command: "_Replay | _Identify | _Inspect", latency: Texts = None
) -> "SignalCalibration":
    """Read the calibration of signals from the vehicle's file, and replace what is given."""
    from ...estimators.wires import read_wires

    known, degrees = read_wires(command.vehicle), command.steering_offset
    offset = None if degrees is None else math.radians(degrees)
    steering = {"ratio": command.steering_ratio, "sign": command.steering_sign, "offset": offset}
    overrides: dict[str, Any] = {k: value for k, value in steering.items() if value is not None}
    late = {**known.latency, **common.parse_options(latency)}
    return known._replace(latency=late, **overrides).check()


def _parse_estimator_options(texts: Texts) -> dict[str, dict[str, Any]]:
    """Parse options by estimator, such as {"joint": {"robust": 0.0}} from "joint.robust=0"."""
    options: dict[str, dict[str, Any]] = {}
    for text in texts or ():
        ((key, value),) = common.parse_options([text]).items()
        name, dot, option = key.partition(".")
        if not (name and dot and option):
            raise ValueError(f"an estimator's option is ESTIMATOR.NAME=VALUE, got {text!r}")
        options.setdefault(name, {})[option] = value
    return options


@register("replay", "Run estimators over a recorded drive.")
class _Replay:
    """Run the estimators over a recorded drive and score them; over a receiver's log (NMEA), which
    has no gyro, filter the fixes with noise that follows HDOP or does not."""

    log: Path = take_argument("A recorded drive: a table, CAN trace, bag or NMEA.", ...)
    vehicle: str = take(
        "A name, a TOML or JSON file, or `identify`: found in the log itself.",
        "passenger-car",
        kinds="vehicles",
    )
    nominal: str = take("The car whose mass and arms `--vehicle identify` takes.", "passenger-car")
    mapping: Texts
    estimator: Texts = take("A name; repeatable; default: all that the log serves.")
    estimator_option: Texts = take("ESTIMATOR.NAME=VALUE (joint.gate=0.99); repeatable.")
    steering_ratio: float | None
    steering_sign: int | None
    steering_offset: float | None
    latency: Texts = take("CHANNEL=S, by which a channel is late (gps=0.2); repeatable.")
    until: float | None = take("s of the log from which `identify` is; the rest is replayed.")
    course_rate: float = take("Hz of the emulated course.", 10.0)
    course_noise: float = take("deg, standard deviation.", 0.5)
    course_delay: float = take("s the course arrives late.", 0.0)
    course_bias: float = take("deg.", 0.0)
    gyro_bias: float = take("deg/s added to the gyro.", 0.0)
    html: File
    json: File
    parquet: File
    plot: File = take("Draw a receiver's track: PNG, PDF, SVG.", ends=".png .pdf .svg")
    kml: File = take("Write a receiver's track for a map.", ends=".kml")

    def run(self) -> None:
        from ...envs.recordings.sources import is_nmea
        from ..recorded.replay import replay_file

        console, log = Console(), self.log
        if is_nmea(log):
            from ..recorded.receiver import draw, make_receiver_suite, replay_nmea, write_kml

            used = "log html json parquet plot kml vehicle estimator"  # as for a batch of logs
            if (self.vehicle, self.estimator) != (type(self).vehicle, type(self).estimator):
                console.print("A receiver's log says nothing of --vehicle and --estimator.")
            common.refuse_unused_options(self, used, f"a receiver's log ({log})")
            with use_shared_bar(console, f"replay {log}"):
                received = replay_nmea(log)
            common.write_output(console, [make_receiver_suite(received)], vars(self))
            for path, write in ((self.plot, draw), (self.kml, write_kml)):
                if path is not None:
                    write(path, received)
            common.print_written(console, self.plot, self.kml)
            return
        if self.plot or self.kml:
            raise ValueError(f"{log}: --plot and --kml are for a receiver's log (NMEA); see --html")
        wires = _read_wires(self, self.latency)
        options = _parse_estimator_options(self.estimator_option)
        with use_shared_bar(console, f"replay {log}"):
            suite = replay_file(
                log, self.vehicle, mapping=self.mapping, wires=wires, nominal=self.nominal,
                until=self.until, estimators=self.estimator, options=options,
                course_rate=self.course_rate, course_noise_deg=self.course_noise,
                delay=self.course_delay, bias_deg=self.course_bias, gyro_bias_degps=self.gyro_bias,
                figures=_has_figures(self.html),
            )  # fmt: skip
        common.write_output(console, [suite], vars(self))


def _has_figures(html: Path | None) -> bool:
    """Return whether a report is written and can have figures."""
    return html is not None and find_spec("plotly") is not None


@register("identify", "Find the car of a recorded drive.")
class _Identify:
    """Find a car's stiffness, inertia, steering, noise and latencies in a recorded drive, with
    intervals, and which of them the log cannot tell; exit status 1, and no file, where nothing is
    identified."""

    log: Path = take_argument("A recorded drive: a table, CAN trace or bag.", ...)
    vehicle: str = take(
        "The car that is stated: its mass and arms stay, the search starts there.",
        "passenger-car",
        kinds="vehicles",
    )
    mapping: Texts
    out: File = take("Write the car and its wires as TOML.", ends=".toml")
    until: float | None = take("s of the log that are used; the rest stays fresh.")
    tyres: Text = take(
        "linear: as stiff as in this drive; fiala: as at small slips; default: what predicts "
        "better."
    )
    validate: bool = take(
        "Also identify from half of the blocks, and drive that car through the others.",
        False,
        "--validate",
    )
    steering_ratio: float | None
    steering_sign: int | None
    steering_offset: float | None

    def run(self) -> None:
        from ...estimators.wires import write_vehicle
        from ..recorded.identify import identify_file

        console, wires = Console(), _read_wires(self)
        with use_shared_bar(console, f"identify {self.log}"):
            arguments = self.log, self.vehicle, self.mapping, wires
            result, suite = identify_file(*arguments, self.tyres, self.until, self.validate)
        print_suite(console, suite)
        if result.reason:
            raise Exit(1)
        if self.out is not None:
            write_vehicle(self.out, result.car, result.wires)
            common.print_written(console, self.out)


@register("inspect", "Judge whether a recorded drive is worth estimating from.")
class _Inspect:
    """Judge a recorded drive before anything is estimated from it: channels, clocks, signs, scales,
    biases, and what can be estimated how well. Exit status 1 where a finding is a BLOCKER."""

    log: Path = take_argument("A recorded drive: CSV, Parquet, MATLAB (.mat) or MDF (.mf4).", ...)
    vehicle: str = take(
        "The car that is assumed: a name or a TOML or JSON file.", "passenger-car", kinds="vehicles"
    )
    mapping: Texts
    steering_ratio: float | None
    steering_sign: int | None
    steering_offset: float | None
    latency: Texts = take("CHANNEL=S, by which a channel is late (gps=0.2); repeatable.")
    html: File

    def run(self) -> None:
        from ..recorded.inspection import inspect_file

        console, wires = Console(), _read_wires(self, self.latency)
        with use_shared_bar(console, f"inspect {self.log}"):
            log = self.log, self.vehicle, self.mapping, wires
            suite = inspect_file(*log, figures=_has_figures(self.html))
        common.write_output(console, [suite], vars(self))
        if suite.verdict.startswith("Do not"):
            raise Exit(1)


@register("lane", "Find the lane in a picture or film.")
class _Lane:
    """Find the lane: heading, offset, curvature and a quality, drawn over the picture.

    Without height and tilt among the intrinsics they are estimated from a picture, for a straight
    lane of the width stated; without intrinsics a lens of usual width is assumed.
    """

    source: File = take_argument("A picture or a film.", None, metavar="IMAGE|VIDEO")
    intrinsics: File = take("The camera: TOML or JSON with K, dist, size, perhaps height and tilt.")
    lane_width: float = take("m, from marking to marking.", 3.7)
    out: File = take("Write what was found on it.", None, "--out", "-o")
    json: File = take("Write the numbers.", ends=".json")
    calibrate: File = take("A folder of chessboards (9 x 6): find the intrinsics.")

    def run(self) -> None:
        os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(_MAX_PIXELS))  # read when loaded
        with require_extra("vision", "the lane finder needs {}"):
            import cv2
        from ...envs.sensors.camera.images import PICTURES, Film, read_picture
        from ...envs.sensors.camera.lane_finder import draw_lane

        source, out = self.source, self.out
        if (source is None) == (self.calibrate is None):
            raise ValueError("expected a picture or a film, or --calibrate FOLDER")
        if source is None:
            common.refuse_unused_options(self, "calibrate json", "--calibrate")
            self._calibrate_camera()
            return
        if not 1.0 < self.lane_width < 10.0:
            raise ValueError(f"--lane-width is 1 to 10 m, got {self.lane_width}")
        cv2.setNumThreads(1)
        still = source.suffix.lower() in PICTURES
        common.check_file(out, ".png .jpg .jpeg" if still else ".mp4 .avi")
        if still:
            try:
                picture = read_picture(source)
            except cv2.error:
                text = f"{source}: expected a picture of at most {_MAX_PIXELS} pixels"
                raise ValueError(text) from None
            finder = self._make_finder([picture], source)
            lanes = [finder.find(picture)]
            if out is not None:
                _, data = cv2.imencode(out.suffix.lower(), draw_lane(picture, finder, lanes[0]))
                write_atomic(out, data.tobytes())
        else:
            film = Film(source)
            finder = self._make_finder(film.read_head(_MAX_TRIES), source)
            lanes = _process_film(film, finder, out)
            if (count := len(lanes)) < film.frame_count:
                _console.print(f"the film ends after {count} of the {film.frame_count} frames due")
        _report(source, finder.camera, lanes)
        if self.json is not None:
            frames = [lane._asdict() for lane in lanes]
            write_document(self.json, {"source": str(source), "frames": frames})
        common.print_written(_console, out, self.json)

    def _calibrate_camera(self) -> None:
        """Write the intrinsics that the chessboards of a folder's pictures give."""
        from ...envs.sensors.camera.images import PICTURES, calibrate_camera

        folder, path = self.calibrate, self.json or Path("intrinsics.json")
        assert folder is not None
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: there is no such folder")
        common.check_file(path, ".json")
        boards = sorted(file for file in folder.iterdir() if file.suffix.lower() in PICTURES)
        camera, error = calibrate_camera(boards)
        numbers = {"K": camera.K, "dist": camera.dist, "size": camera.size, "rms_px": error}
        write_document(path, numbers)
        _console.print(f"corners within {error:.2f} px rms in {len(boards)} pictures")
        common.print_written(_console, path)

    def _make_finder(self, pictures: "list[Image]", source: Path) -> "LaneFinder":
        """Make a finder; height and tilt, if not in a file, are those of the first fit picture."""
        from ...envs.sensors.camera.images import Pinhole, make_default_camera
        from ...envs.sensors.camera.lane_finder import estimate_mounting, make_lane_finder

        file, lane_width, known = self.intrinsics, self.lane_width, dict[str, object]()
        height, width = pictures[0].shape[:2]
        if file is None:
            camera = make_default_camera((width, height))
        else:
            try:
                camera, known = Pinhole.read(file), read_document(file, "camera")
            except OverflowError as error:
                raise ValueError(f"{file}: {error}") from None
        if camera.size != (width, height):
            expected, got = ("{} x {}".format(*size) for size in (camera.size, (width, height)))
            text = f"{file}: the camera's pictures are {expected} pixels, those of {source} {got}"
            raise ValueError(text)
        failed = None
        for picture in pictures if not {"height", "tilt"} <= known.keys() else ():
            try:
                camera = estimate_mounting(camera, picture, lane_width)
                break
            except ValueError as error:
                failed = error
        else:
            if failed is not None:
                raise ValueError(f"{source}: {failed}")
        return make_lane_finder(camera, lane_width)


def _process_film(film: "Film", finder: "LaneFinder", out: Path | None) -> list["Lane"]:
    """Find a film's lanes, and draw them."""
    import cv2

    from ...envs.sensors.camera.lane_finder import draw_lane

    with TemporaryDirectory() as folder, use_shared_bar(_console, "lane", "pictures") as bar:
        pictures = bar.track(film, film.frame_count or None, task_id=bar.task_ids[0])
        if out is None:
            return [finder.find(picture) for picture in pictures]
        lanes, part = [], Path(folder, f"lane{out.suffix.lower()}")
        code = cv2.VideoWriter.fourcc(*("mp4v" if part.suffix == ".mp4" else "MJPG"))
        writer = cv2.VideoWriter(str(part), code, film.rate, finder.camera.size)
        for picture in pictures:
            lanes.append(finder.find(picture))
            writer.write(draw_lane(picture, finder, lanes[-1]))
        writer.release()
        write_atomic(out, part.read_bytes())
    return lanes


def _report(source: Path, camera: "Pinhole", lanes: list["Lane"]) -> None:
    """Print the lanes and the camera's mounting."""
    shown = [lane for lane in lanes if lane.quality > 0.0]
    lines = [f"{source.name}: a lane in {len(shown)} of {len(lanes)} frames"]
    if len(lanes) == 1:
        lines = [f"{source.name}: {lanes[0].describe()}"]
    elif shown:
        psi, y, quality = np.array([(lane.psi, lane.y, lane.quality) for lane in shown]).T
        lines.append(
            f"psi {np.degrees(psi.mean()):+.2f} deg (sd {np.degrees(psi.std()):.2f}), offset "
            f"{y.mean():+.2f} m (sd {y.std():.2f}), quality {np.mean(quality):.2f}"
        )
    tilt = np.degrees(camera.tilt)
    lines.append(f"camera {camera.height:.2f} m high, tilted {tilt:+.2f} deg")
    _console.print("\n".join(lines), markup=False)
