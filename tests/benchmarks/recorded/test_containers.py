"""One drive in ten containers gives the same record; what is wrong with a file is one line."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sideslip.envs.record import FAST, PACKET, Log
from sideslip.envs.recordings.log_file import read_parts
from sideslip.envs.recordings.tables import parse_mapping

from .simulated import as_table
from .simulated import drive as simulate

can = pytest.importorskip("can")
cantools = pytest.importorskip("cantools")
asammdf = pytest.importorskip("asammdf")
h5py = pytest.importorskip("h5py")
pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")

DBC = """VERSION ""
NS_ :
BS_:
BU_: Car
BO_ 256 Motion: 8 Car
 SG_ Speed : 0|16@1+ (0.00390625,0) [0|256] "m/s" Car
 SG_ YawRate : 16|16@1- (0.0001220703125,0) [-4|4] "rad/s" Car
 SG_ AccelY : 32|16@1- (0.00390625,0) [-128|128] "m/s^2" Car
 SG_ Steer : 48|16@1- (0.00006103515625,0) [-2|2] "rad" Car
BO_ 512 Gps: 8 Car
 SG_ Course : 0|16@1- (0.000244140625,0) [-8|8] "rad" Car
 SG_ Quality : 16|16@1+ (0.0625,0) [0|99] "" Car
"""
FAST_COLUMNS = {
    "speed_x_mps": "Speed", "yaw_rate_radps": "YawRate", "accel_y_mps2": "AccelY",
    "steer_rad": "Steer",
}  # fmt: skip
COLUMNS = {**FAST_COLUMNS, "course_rad": "Course"}


@functools.cache
def table() -> pd.DataFrame:
    """Twelve seconds of a drive of ours, rounded to what the bus resolves."""
    frame = as_table(simulate(3)[0]).iloc[:1200]
    messages = cantools.database.load_string(DBC).messages
    scale = {signal.name: signal.scale for message in messages for signal in message.signals}
    columns = {x: np.round(frame[x] / scale[name]) * scale[name] for x, name in COLUMNS.items()}
    return pd.DataFrame({"time_s": 0.01 * np.arange(1000, 1000 + len(frame)), **columns})


def frames() -> list[Any]:
    database, sent = cantools.database.load_string(DBC), []
    for values in table().to_dict("records"):
        known = [("Motion", FAST_COLUMNS)]
        known += [("Gps", {"course_rad": "Course"})] if np.isfinite(values["course_rad"]) else []
        for name, columns in known:
            message = database.get_message_by_name(name)
            signals = {signal: values[column] for column, signal in columns.items()}
            data = message.encode(signals | ({"Quality": 4.0} if name == "Gps" else {}))
            stamp, number = values["time_s"], message.frame_id
            sent.append(can.Message(stamp, number, is_extended_id=False, data=data))
    return sent


def write_dbc(folder: Path, text: str = DBC) -> Path:
    path = folder / "car.dbc"
    path.write_text(text)
    return path


def write_trace(
    folder: Path, name: str, change: Callable[[int, Any], None] = lambda i, frame: None
) -> Path:
    write_dbc(folder)
    with can.Logger(folder / name) as logger:
        for i, frame in enumerate(frames()):
            change(i, frame)
            logger.on_message_received(frame)
    return folder / name


def write_raw_mf4(folder: Path) -> Path:
    write_dbc(folder)
    sent, name = frames(), "CAN_DataFrame"
    parts = {
        "BusChannel": np.ones(len(sent), "u1"),
        "ID": np.array([x.arbitration_id for x in sent], "<u4"),
        "IDE": np.zeros(len(sent), "u1"),
        "DLC": np.full(len(sent), 8, "u1"),
        "DataLength": np.full(len(sent), 8, "u1"),
        "DataBytes": np.array([list(x.data) for x in sent], "u1"),
    }
    samples = np.rec.fromarrays(
        list(parts.values()),
        dtype=[(f"{name}.{key}", x.dtype, x.shape[1:]) for key, x in parts.items()],
    )
    source = asammdf.blocks.source_utils.Source("CAN", "CAN", "", 2, 2)  # a bus, of CAN
    stamps = np.array([x.timestamp for x in sent])
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(samples, stamps, name=name, source=source)], acq_source=source)
        return Path(file.save(folder / "drive.mf4", overwrite=True))


def write_bag(folder: Path, storage: str, late: float = 0.0) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types, path = store.types, folder / "bag"
    kinds = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Vector3Stamped")
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage]) as writer:
        motion, gps = (
            writer.add_connection(topic, kind, typestore=store)
            for topic, kind in zip(("/motion", "/gps"), kinds, strict=True)
        )
        for time, speed, yaw_rate, accel, steer, course in table().itertuples(index=False):
            stamp = round(1e9 * time)
            when = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
            header = types["std_msgs/msg/Header"](when, "car")
            vector = types["geometry_msgs/msg/Vector3"]
            parts = vector(speed, accel, steer), vector(0.0, 0.0, yaw_rate)
            twist = types["geometry_msgs/msg/Twist"](*parts)
            raw = store.serialize_cdr(types[kinds[0]](header, twist), kinds[0])
            writer.write(motion, stamp, raw)
            if np.isfinite(course):
                fix = types[kinds[1]](header, vector(course, 0.0, 0.0))
                raw = store.serialize_cdr(fix, kinds[1])
                writer.write(gps, stamp + round(1e9 * late), raw)
    return path


BAG = {
    "speed_x_mps": "/motion:twist.linear.x",
    "yaw_rate_radps": "/motion:twist.angular.z",
    "accel_y_mps2": "/motion:twist.linear.y",
    "steer_rad": "/motion:twist.linear.z",
    "course_rad": "/gps:vector.x",
}


def write_mcap(folder: Path) -> Path:
    (path,) = write_bag(folder, "MCAP").glob("*.mcap")
    return path


def write_mat(folder: Path, v73: bool) -> Path:
    from scipy.io import savemat

    path, columns = folder / "drive.mat", {name: x.to_numpy() for name, x in table().items()}
    if not v73:
        savemat(path, columns | {"note": "x", "k": 3.0})
        return path
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in columns.items():
            file[str(name)] = values[None]
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(128))
    return path


def write_vbo(folder: Path) -> Path:
    frame = table()
    names = ["time", *map(str, frame.columns[1:])]
    rows = [[f"{x.time_s:.2f}".zfill(9), *map(repr, x[1:])] for x in frame.itertuples(index=False)]
    head = "File created\n\n[header]\nx\n\n[column names]\n" + " ".join(names) + "\n\n[data]\n"
    path = folder / "drive.vbo"
    path.write_text(head + "\n".join(" ".join(row) for row in rows) + "\n")
    return path


def save(folder: Path, ending: str) -> Path:
    path = folder / f"drive.{ending}"
    table().to_csv(path, index=False) if ending == "csv" else table().to_parquet(path)
    return path


CONTAINERS: dict[str, tuple[Callable[[Path], Path], Mapping[str, str]]] = {
    "Parquet": (lambda folder: save(folder, "parquet"), {}),
    "MATLAB": (lambda folder: write_mat(folder, False), {}),
    "MATLAB 7.3": (lambda folder: write_mat(folder, True), {}),
    "VBO": (write_vbo, {}),
    "BLF": (lambda folder: write_trace(folder, "drive.blf"), COLUMNS),
    "ASC": (lambda folder: write_trace(folder, "drive.asc"), COLUMNS),
    "candump": (lambda folder: write_trace(folder, "drive.log"), COLUMNS),
    "raw MF4": (write_raw_mf4, COLUMNS),
    "ROS 2 bag": (lambda folder: write_bag(folder, "SQLITE3"), BAG),
    "MCAP": (write_mcap, BAG),
}


def read(path: Path, mapping: Mapping[str, str]) -> Log:
    dbc = path.parent / "car.dbc"
    known = dict(mapping) | ({"dbc": str(dbc)} if dbc.exists() else {})
    (log,), _ = read_parts(path, known)
    return log


@pytest.mark.parametrize("kind", CONTAINERS)
def test_a_drive_is_the_same_in_every_container(tmp_path: Path, kind: str) -> None:
    write, mapping = CONTAINERS[kind]
    plain = read(save(tmp_path, "csv"), {})
    log = read(write(tmp_path), mapping)
    np.testing.assert_array_equal(log.record.fast, plain.record.fast)
    packets, known = (x.record.packets.copy() for x in (log, plain))
    assert len(packets) > 20 and log.record.dt == plain.record.dt == 0.01
    for ticks in (PACKET.captured, PACKET.arrived):  # an ASC begins at 0
        packets[:, ticks] -= log.record.first
        known[:, ticks] -= plain.record.first
    np.testing.assert_array_equal(packets, known)
    assert log.slow["gps"].period == plain.slow["gps"].period


def test_a_header_says_when_a_sample_was_taken_and_the_log_when_it_came(tmp_path: Path) -> None:
    log = read(write_bag(tmp_path, "SQLITE3", late=0.123), BAG)
    late = log.record.packets[:, PACKET.arrived] - log.record.packets[:, PACKET.captured]
    np.testing.assert_array_equal(late, 13.0)
    assert log.slow["gps"].delays == (0.13,) and log.slow["gps"].jitter == 0.0
    frame = table().assign(gps_latency_ms=123.0)
    frame.to_csv(tmp_path / "late.csv", index=False)
    (same,), _ = read_parts(tmp_path / "late.csv")
    np.testing.assert_array_equal(same.record.packets, log.record.packets)


def test_a_bag_that_was_recorded_again_has_punctual_samples(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "SQLITE3", late=900.0)
    (log,), remarks = read_parts(path, BAG)
    packets = log.record.packets
    np.testing.assert_array_equal(packets[:, PACKET.captured], packets[:, PACKET.arrived])
    assert any("up to 900 s beside the headers'" in text for text in remarks)


def test_a_vbox_has_its_own_names_and_units(tmp_path: Path) -> None:
    text = "File created on 1/1/2026\n[column names]\n"
    text += "sats time lat long velocity heading Yaw Steer\n[data]\n"
    for i in range(400):
        t = 59.0 + 0.01 * i
        text += f"008 0959{t:06.3f} {3000.0 + 1e-4 * i:+.6f} {-480.0:+.6f} 72.0 090.0 5.0 1.0\n"
        text = text.replace("095960", "100000").replace("09596", "10000")
    path = tmp_path / "a.vbo"
    path.write_text(text)
    (log,), _ = read_parts(path, {"yaw_rate_degps": "Yaw", "steer_deg": "Steer"})
    assert log.time[-1] - log.time[0] == pytest.approx(3.99) and log.time[0] == 35_999.0
    np.testing.assert_allclose(log.record.fast[:, FAST.wheel_left], 20.0)
    gps = log.record.select_packets("gps")[:, PACKET.value :]
    np.testing.assert_allclose(gps[:, 0], 0.0, atol=1e-12)  # east
    np.testing.assert_allclose(gps[-1, 3] - gps[0, 3], 399e-4 / 60.0 * 111_230.0, rtol=1e-3)


def test_a_long_trace_costs_its_wanted_samples_alone(tmp_path: Path) -> None:
    import tracemalloc

    path, n = tmp_path / "long.log", 60_000
    other = "(1.000000) can0 333#" + "00" * 8 + "\n"
    with path.open("w") as file:
        for i in range(0, n, 100):
            file.write(f"({10 + 0.01 * i / 100:.6f}) can0 100#0014000000000000\n" + other * 99)
    tracemalloc.start()
    (log,), _ = read_parts(path, {**FAST_COLUMNS, "dbc": str(write_dbc(tmp_path))})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(log.record.fast) == n / 100
    assert peak < path.stat().st_size  # of 2.2 MB


def test_a_mapping_stands_in_a_file(tmp_path: Path) -> None:
    entries = {"dbc": "car.dbc", **COLUMNS}
    preset = tmp_path / "bus.toml"
    preset.write_text("\n".join(f'{name} = "{column}"' for name, column in entries.items()))
    mapping = parse_mapping([str(preset)])
    assert mapping == entries | {"dbc": str(tmp_path / "car.dbc")}
    assert len(read(write_trace(tmp_path, "a.blf"), mapping).record.fast) == 1200
    with pytest.raises(ValueError, match="course_rad is mapped twice, to 'Course' and to 'Other'"):
        parse_mapping([str(preset), "course_rad=Other"])


def cut(path: Path) -> Path:
    """Leave two thirds; of a candump half of the last digit pair (a line ends with " R")."""
    data = path.read_bytes()
    end = 2 * len(data) // 3
    end = data.rindex(b"\n", 0, end) - 3 if path.suffix == ".log" else end
    path.write_bytes(data[:end])
    return path


@pytest.mark.parametrize("ending", ["log", "asc", "blf"])
def test_a_trace_that_is_cut_is_read_up_to_there(tmp_path: Path, ending: str) -> None:
    path = cut(write_trace(tmp_path, f"drive.{ending}"))
    (log,), remarks = read_parts(path, {**COLUMNS, "dbc": str(tmp_path / "car.dbc")})
    assert 600 < len(log.record.fast) < 1000, remarks
    assert any("WARNING" in x and ("cut" in x or "shorter" in x) for x in remarks), remarks


@pytest.mark.parametrize("kind", ["raw MF4", "MCAP", "MATLAB 7.3"])
def test_a_container_that_is_cut_is_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    write, mapping = CONTAINERS[kind]
    path = cut(write(tmp_path))
    with pytest.raises(ValueError, match="but ") as caught:
        read(path, mapping)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_formula_in_an_mdf_runs_nothing(tmp_path: Path) -> None:
    """asammdf hands what is no arithmetic to Python's eval."""
    frame, marker = table(), tmp_path / "ran"

    def save_scaled(formula: str) -> Path:
        scaled = {"yaw_rate_radps": {"formula": formula}}
        columns = [(x, frame[x].to_numpy(), scaled.get(x)) for x in FAST_COLUMNS]
        time = frame["time_s"].to_numpy()
        with asammdf.MDF(version="4.10") as file:
            file.append([asammdf.Signal(v, time, name=x, conversion=c) for x, v, c in columns])
            return Path(file.save(tmp_path / "drive.mf4", overwrite=True))

    path = save_scaled(f"__import__('os').mkdir('{marker}') or X1")
    with pytest.raises(ValueError, match="yaw_rate_radps has a formula that is no arithmetic"):
        read_parts(path)
    assert not marker.exists()
    (log,), _ = read_parts(save_scaled("2*X1"))
    np.testing.assert_allclose(log.record.fast[:, FAST.gyro], 2.0 * frame["yaw_rate_radps"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda i, frame: setattr(frame, "channel", f"can{i % 2}"), "0x100 is on several buses"),
        (
            lambda i, frame: setattr(frame, "timestamp", frame.timestamp - 5.0 * (i > 600)),
            "the clock is set back, .* s after .* s; cut the file there",
        ),
    ],
)
def test_a_trace_of_two_buses_or_clocks_is_refused(
    tmp_path: Path, change: Callable[[int, Any], None], message: str
) -> None:
    path = write_trace(tmp_path, "drive.log", change)
    with pytest.raises(ValueError, match=message):
        read_parts(path, {**COLUMNS, "dbc": str(tmp_path / "car.dbc")})


def test_a_message_names_one_of_two_signals(tmp_path: Path) -> None:
    """That it is ours by name, as its namesake is, is no matter then."""
    path = write_trace(tmp_path, "drive.blf")
    text = TWICE.replace("SG_ Speed :", "SG_ Speed_X :")
    mapping = {**COLUMNS, "speed_x_mps": "Motion.Speed_X", "dbc": str(write_dbc(tmp_path, text))}
    (log,), _ = read_parts(path, mapping)
    np.testing.assert_array_equal(log.record.fast[:, FAST.wheel_left], table()["speed_x_mps"])


OTHER = DBC.replace("BO_ 256", "BO_ 300").replace("BO_ 512", "BO_ 600")
TWICE = DBC.replace('Quality : 16|16@1+ (0.0625,0) [0|99] ""', 'Speed : 16|16@1+ (0.1,0) [0|99] ""')
IDLE = DBC + 'BO_ 700 Idle: 8 Car\n SG_ Rack : 0|8@1+ (1,0) [0|1] "" Car\n'
REFUSALS: dict[str, tuple[str, Mapping[str, str], str]] = {
    "no description": ("", COLUMNS, "needs its description: --map dbc=FILE"),
    "another car's": (OTHER, COLUMNS, r"none of its 2 ids \(0x100, 0x200, ...\) is in .*car.dbc"),
    "no description at all": ("hello", COLUMNS, "car.dbc describes no CAN frames"),
    "two of one name": (TWICE, COLUMNS, "share a name; --map one of Motion.Speed, Gps.Speed"),
    "no such signal": (DBC, {**COLUMNS, "steer_rad": "Rack"}, "no column 'Rack' for steer_rad"),
    "an empty channel": (IDLE, {**COLUMNS, "steer_rad": "Rack"}, "no column 'Rack' for steer_rad"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_trace_with_a_wrong_description_is_refused(tmp_path: Path, case: str) -> None:
    text, mapping, message = REFUSALS[case]
    path = write_trace(tmp_path, "drive.blf")
    known = {"dbc": str(write_dbc(tmp_path, text))} if text else {}
    with pytest.raises(ValueError, match=message) as caught:
        read_parts(path, {**mapping, **known})
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("label", "message"),
    [
        ("", "expected a file, found a folder"),
        ("/imu:twist.angular.z", "no topic '/imu'; the bag has /gps, /motion"),
        ("/motion:twist.angular.w", "no field 'twist.angular.w': 'w' is none of x, y, z"),
        ("/motion:twist.angular", "is no number, but"),
    ],
)
def test_a_bag_without_what_is_asked_is_refused(tmp_path: Path, label: str, message: str) -> None:
    path = write_bag(tmp_path, "SQLITE3")
    if not label:  # no bag at all
        (path / "metadata.yaml").unlink()
    with pytest.raises(ValueError, match=message):
        read_parts(path, BAG | {"yaw_rate_radps": label})


def test_a_value_that_is_not_available_is_no_measurement(tmp_path: Path) -> None:
    def lose(i: int, frame: Any) -> None:
        if frame.arbitration_id == 256 and 400 <= i < 410:
            frame.data[2:4] = b"\xff\x7f"

    path = write_trace(tmp_path, "drive.log", lose)
    dbc = write_dbc(tmp_path, DBC + 'VAL_ 256 YawRate 32767 "Signal_Not_Available" ;\n')
    (log,), remarks = read_parts(path, {**COLUMNS, "dbc": str(dbc)})
    assert np.abs(log.record.fast[:, FAST.gyro]).max() < 3.9
    assert any("not available are left out" in text for text in remarks)
