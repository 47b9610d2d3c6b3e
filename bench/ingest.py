"""How long, and in how much memory, tables of the size of nuScenes v1.0-trainval are ingested.

    python bench/ingest.py --root /tmp/tables [--scenes 850] [--images] [--devkit-python OTHER_ENV/bin/python]

makes the tables if need be, ingests them in a process of its own and, given the Python of an environment that holds
nuscenes-devkit, loads the same tables there. With --images every camera file exists (a link to a few real JPEGs) and
is checked. Prints a table; writes bench/out/ingest.json.
"""

import argparse
import io
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TextIO

VERSION = "v1.0-trainval"
START_US = 1_531_281_439_000_000
SCENE_S = 20.0
KEYFRAMES = 40  # of a scene, at 2 Hz
CAMERAS = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
RADARS = ("RADAR_FRONT", "RADAR_FRONT_LEFT", "RADAR_FRONT_RIGHT", "RADAR_BACK_LEFT", "RADAR_BACK_RIGHT")
FILES_A_SCENE = {"camera": 235, "lidar": 390, "radar": 259}  # times 850 scenes: 2.63 million, as in v1.0-trainval
LINKS_A_FILE = 60_000  # ext4 allows 65,000 names for a file
MEMORY_LIMIT = 16 << 30  # bytes; a load that wants more is ended
EMPTY_TABLES = ("category", "attribute", "visibility", "instance", "sample_annotation")
LIMIT = f"import resource, sys; resource.setrlimit(resource.RLIMIT_AS, ({MEMORY_LIMIT}, {MEMORY_LIMIT}));"
DEVKIT_LOAD = (
    "from nuscenes import NuScenes; data = NuScenes(sys.argv[2], sys.argv[1], verbose=False);"
    "print(len(data.sample_data), 'files of all sensors')"
)
OUR_INGEST = (
    "from pathlib import Path; from stages.ingest import ingest_nuscenes;"
    "drives = list(ingest_nuscenes(Path(sys.argv[1]), sys.argv[2], images=sys.argv[3]));"
    "print(len(drives), 'drives,', sum(len(drive.frames) for drive in drives), 'frames')"
)


@dataclass(frozen=True)
class Measurement:
    """One process, from its start to its end."""

    what: str
    wall_s: float
    processor_s: float
    peak_rss_gib: float
    output: str


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="folder of the data set; made if absent")
    parser.add_argument("--scenes", type=int, default=850)
    parser.add_argument("--images", action="store_true", help="make and check the camera files too")
    parser.add_argument("--devkit-python", type=Path)
    arguments = parser.parse_args()
    make_dataset(arguments.root, arguments.scenes, arguments.images)
    warm_page_cache(arguments.root / VERSION)
    checks = "check" if arguments.images else "trust"
    command = [sys.executable, "-c", LIMIT + OUR_INGEST, str(arguments.root), VERSION, checks]
    results = [measure(f"presight ({checks} images)", command)]
    if arguments.devkit_python:
        command = [str(arguments.devkit_python), "-c", LIMIT + DEVKIT_LOAD, str(arguments.root), VERSION]
        results.append(measure("nuscenes-devkit", command))
    show(results, arguments.root / VERSION)
    out = Path(__file__).parent / "out"
    out.mkdir(exist_ok=True)
    (out / "ingest.json").write_text(json.dumps([asdict(result) for result in results], indent=2))


def measure(what: str, command: list[str]) -> Measurement:
    """Run a command alone."""
    print(f"running {what} ...", flush=True)
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    output = process.stdout.read() if process.stdout else ""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        output = f"failed with exit code {process.returncode}"
    wall_s = time.perf_counter() - start
    # Linux counts the peak in KiB.
    return Measurement(what, wall_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 2**20, output.strip())


def warm_page_cache(folder: Path) -> None:
    """Read the tables once, so that nobody pays for the disk alone."""
    for file in folder.iterdir():
        with file.open("rb") as source:
            while source.read(1 << 24):
                pass


def show(results: list[Measurement], folder: Path) -> None:
    """Print the results side by side."""
    size_gib = sum(file.stat().st_size for file in folder.iterdir()) / 2**30
    print(f"\n{folder}: {size_gib:.2f} GiB of tables; {os.cpu_count()} cores")
    print(f"{'':28}{'wall s':>9}{'cpu s':>9}{'peak GiB':>10}  output")
    for result in results:
        print(
            f"{result.what:28}{result.wall_s:9.1f}{result.processor_s:9.1f}{result.peak_rss_gib:10.2f}  {result.output}"
        )


def make_dataset(root: Path, scene_count: int, images: bool) -> None:
    """Write the tables, and the images if wanted, unless they are there."""
    folder = root / VERSION
    if not (folder / "sample_data.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        print(f"making tables of {scene_count} scenes ...", flush=True)
        Tables(folder).write(scene_count)
    if images and not (root / "samples").exists():
        print("making images ...", flush=True)
        make_images(root)


class Tables:
    """Writes made-up tables in the layout of the released ones: a field a line."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.random = random.Random(0)

    def token(self) -> str:
        """A new token of 32 hex digits."""
        return f"{self.random.getrandbits(128):032x}"

    def write(self, scene_count: int) -> None:
        """All tables."""
        log = self.token()
        sensors = [(channel, "camera") for channel in CAMERAS] + [("LIDAR_TOP", "lidar")]
        sensors += [(channel, "radar") for channel in RADARS]
        sensor_tokens = {channel: self.token() for channel, _ in sensors}
        rows = {name: [] for name in ("scene", "sample", "calibrated_sensor", *EMPTY_TABLES)}
        rows["log"] = [row_of(token=log, logfile="log", vehicle="n015", date_captured="2018-07-24", location="bench")]
        rows["sensor"] = [
            row_of(token=sensor_tokens[channel], channel=channel, modality=kind) for channel, kind in sensors
        ]
        rows["map"] = [row_of(category="semantic_prior", token=self.token(), filename="maps/m.png", log_tokens=[log])]
        part = self.folder / "sample_data.json.part"
        with part.open("w") as data, (self.folder / "ego_pose.json").open("w") as ego:
            separator = "[\n"
            for scene in range(scene_count):
                files = self.scene(scene, log, sensors, sensor_tokens, rows)
                separator = self.files(files, data, ego, separator)
            data.write("\n]")
            ego.write("\n]")
        for name, table in rows.items():
            (self.folder / f"{name}.json").write_text(json.dumps(table, indent=0))
        (self.folder.parent / "maps").mkdir(exist_ok=True)
        save_image(self.folder.parent / "maps" / "m.png", 8, 8)
        part.rename(self.folder / "sample_data.json")  # last: it marks completion

    def scene(self, scene: int, log: str, sensors: list, sensor_tokens: dict, rows: dict) -> Iterator[dict]:
        """The files of a scene; its rows of the small tables are appended."""
        token, samples = self.token(), [self.token() for _ in range(KEYFRAMES)]
        start_us = START_US + int(scene * 2 * SCENE_S * 1e6)
        ends = {"first_sample_token": samples[0], "last_sample_token": samples[-1]}
        rows["scene"].append(
            row_of(token=token, log_token=log, nbr_samples=KEYFRAMES, name=f"scene-{scene:04}", description="", **ends)
        )
        for number, (before, sample, after) in enumerate(
            zip(["", *samples[:-1]], samples, [*samples[1:], ""], strict=True)
        ):
            time_us = start_us + number * 500_000
            rows["sample"].append(row_of(token=sample, timestamp=time_us, prev=before, next=after, scene_token=token))
        for channel, kind in sensors:
            rows["calibrated_sensor"].append(self.calibration(sensor_tokens[channel], kind))
            mounted = rows["calibrated_sensor"][-1]["token"]
            yield {"channel": channel, "kind": kind, "mounted": mounted, "samples": samples, "start_us": start_us}

    def calibration(self, sensor: str, kind: str) -> dict:
        """A sensor as mounted."""
        intrinsics = [[1266.417203046554, 0.0, 816.2670197447984], [0.0, 1266.417203046554, 491.50706579294757]]
        return row_of(
            token=self.token(),
            sensor_token=sensor,
            translation=[1.70079118954, 0.0159456324149, 1.51095763913],
            rotation=[0.5, -0.5, 0.5, -0.5],
            camera_intrinsic=[*intrinsics, [0.0, 0.0, 1.0]] if kind == "camera" else [],
        )

    def files(self, sensors: Iterator[dict], data: TextIO, ego: TextIO, separator: str) -> str:
        """Write a row of both large tables for every file of a scene; the separator for the next."""
        for sensor in sensors:
            count = FILES_A_SCENE[sensor["kind"]]
            tokens = ["", *(self.token() for _ in range(count)), ""]
            for number in range(count):
                before, token, after = tokens[number : number + 3]
                data.write(separator + data_row(sensor, number, count, (before, token, after)))
                ego.write(separator + pose_row(token, time_of(sensor, number, count), number))
                separator = ",\n"
        return separator


def row_of(**values: object) -> dict:
    """A row."""
    return values


def time_of(sensor: dict, number: int, count: int) -> int:
    """When a file was taken, microseconds."""
    return sensor["start_us"] + int(number * SCENE_S * 1e6 / count)


def data_row(sensor: dict, number: int, count: int, tokens: tuple[str, str, str]) -> str:
    """A row of sample_data, laid out as in the released table."""
    before, token, after = tokens
    time_us, is_camera = time_of(sensor, number, count), sensor["kind"] == "camera"
    keyframe = number * KEYFRAMES // count
    is_keyframe = number == 0 or (number - 1) * KEYFRAMES // count < keyframe
    width, height, suffix = (1600, 900, "jpg") if is_camera else (0, 0, "pcd")
    folder, channel = "samples" if is_keyframe else "sweeps", sensor["channel"]
    return (
        f'{{\n"token": "{token}",\n"sample_token": "{sensor["samples"][keyframe]}",\n"ego_pose_token": "{token}",\n'
        f'"calibrated_sensor_token": "{sensor["mounted"]}",\n"timestamp": {time_us},\n"fileformat": "{suffix}",\n'
        f'"is_key_frame": {"true" if is_keyframe else "false"},\n"height": {height},\n"width": {width},\n'
        f'"filename": "{folder}/{channel}/n015-2018-07-24-11-22-45+0800__{channel}__{time_us}.{suffix}",\n'
        f'"prev": "{before}",\n"next": "{after}"\n}}'
    )


def pose_row(token: str, time_us: int, number: int) -> str:
    """A row of ego_pose, with as many digits as the released ones."""
    x, y = 411.3039349319818 + number / 7, 1180.8903791765097 + number / 11
    rotation = "[\n0.5720320396729045,\n-0.0016977771610471074,\n0.011798001930183783,\n-0.8201446642457809\n]"
    return (
        f'{{\n"token": "{token}",\n"timestamp": {time_us},\n"rotation": {rotation},\n'
        f'"translation": [\n{x!r},\n{y!r},\n0.0\n]\n}}'
    )


def make_images(root: Path) -> None:
    """A name for every camera file of the tables, all of them links to a few real images."""
    from stages.nuscenes import read_dataset

    paths = read_dataset(root, VERSION).images.path
    for folder in {path.rpartition("/")[0] for path in paths}:
        (root / folder).mkdir(parents=True, exist_ok=True)
    for number, path in enumerate(paths):
        if number % LINKS_A_FILE == 0:
            original = root / f"original_{number}.jpg"
            save_image(original, 1600, 900)
        os.link(original, root / path)


def save_image(file: Path, width_px: int, height_px: int) -> None:
    """A noisy grey image."""
    from PIL import Image

    content = io.BytesIO()
    image = Image.effect_noise((width_px // 8, height_px // 8), 64) if width_px > 8 else Image.new("L", (8, 8))
    image.resize((width_px, height_px)).save(content, file.suffix[1:].replace("jpg", "jpeg"))
    file.write_bytes(content.getvalue())


if __name__ == "__main__":
    main()
