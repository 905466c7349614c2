"""Make the pictures of docs/gallery: python docs/make_gallery.py [out] [--only NAME ...] [-o FOLDER]

`out` is the folder of `jawusd build examples/capture -o out`. A picture whose program is not installed is named and
left as it was: `viewer`, `pose_page`, `phone`, `report` and `jaw` want Chromium and playwright, `blender` the
environment blender45 of `tests/interop/make_environments.py` in the folder that JAWUSD_INTEROP names. `face_solver`
takes minutes. The charts of the guides are in gallery_charts.py.
"""

import argparse
import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).parent))
from gallery_charts import CHARTS, capture_of, incisal_point, run_jawusd

import jawusd
from jawusd.evaluator import JawRig
from jawusd.formats.capture import load_capture
from jawusd.formats.mesh import DEEP, TOUCHING
from jawusd.formats.tracks import load_tracks
from jawusd.media.overlay import placed_scans
from jawusd.media.writers import VideoWriter
from jawusd.paper.figures import condyle_figure
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import tracked_scans
from jawusd.pipeline.pictures import open_wall
from jawusd.pipeline.report import run_paper_experiments
from jawusd.pipeline.state import no_progress
from jawusd.pipeline.subject import subject_of_build
from jawusd.pipeline.view import ContactView, open_viewer, viewed_actor, write_page
from jawusd.report.style import BLUE, VERMILION, figure_bytes
from jawusd.rig import describe
from jawusd.viewer.readouts import rest_places
from jawusd.viewer.scene import preset_view
from jawusd.viewer.server import Viewer
from jawusd.viewer.widgets import set_theme

ROOT = Path(__file__).resolve().parents[1]
CAPTURE = ROOT / "examples" / "capture"
FIRST, FRAMES, STEP = 128, 120, 2  # of the clips: opens wide and moves to the side; every second frame, in real time
TILE_PX = (320, 240)
JAW_FRAMES = (42, 139)  # of the take, from one closed bite to the next
JAW_PX, PANELS_PX = (640, 480), (324, 364)  # size of the picture, and of the panels to its left and right
JAW_FROM_MM, JAW_AIM_MM = np.array([132.0, 0.0, 205.0]), np.array([0.0, -34.0, 0.0])  # camera and aim off the jaw
# Keys of the pose page: place on the timeline, as a share of its length, and d [mm].
KEYS_SHOWN = ((0.05, (0, 0, 0)), (0.25, (28, 0, 0)), (0.45, (12, 6, 1)), (0.62, (2, -5, 1)), (0.8, (18, 2, 3)))
DRAWN_MS = 700  # until a pose is drawn without a graphics card
PATIENCE_MS = 120_000  # for the page of the viewer, drawn without a graphics card


FOOTAGE_FRAMES, VIEWED_FRAME = (20, 60), 168  # of the example capture
# Function that makes a picture from the folder of a build, in a folder.
Picture = Callable[[Path, Path], Path]


class NotInstalledError(Exception):
    """Say what a picture needs that is not here."""


def save_webp(path: Path, image: Image.Image, width_px: int) -> Path:
    """Save a picture, reduced to a width; return the file."""
    size = width_px, round(image.height * width_px / image.width)
    image.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(path, quality=84, method=6)
    return path


def drawn(figure: Figure) -> Image.Image:
    """Return a figure as a picture."""
    return Image.open(io.BytesIO(figure_bytes(figure, "png", 200)))


def overlay(out: Path, folder: Path, frames: int = FRAMES) -> Path:
    """Draw the tracked scans over the footage, all cameras side by side."""
    capture, tracks = load_capture(CAPTURE), load_tracks(out / "tracks.npz")
    offsets, scans = sync_cameras(capture, no_progress)["offsets"], tracked_scans(capture, tracks)
    wall = open_wall(capture, offsets, tracks, scans, TILE_PX)
    path, (width, height) = folder / "overlay.mp4", (side // 2 * 2 for side in wall.size_px)
    with contextlib.closing(wall), VideoWriter(path, (width, height), capture.fps / STEP, quality_crf=27) as video:
        for row in range(FIRST, FIRST + frames, STEP):
            picture = wall.draw(int(tracks.frames[row]), placed_scans(tracks, row, scans), fill=0.15)
            video.write(picture[:height, :width])
    return path


def border(rig: JawRig, openings: int = 60, ways: int = 72) -> np.ndarray:
    """Return parameters on the bound [mm], shape (openings, ways, 3): at every opening as far as each way goes."""
    d1, angle = np.linspace(*rig.d_range[0], openings), np.linspace(0, 2 * np.pi, ways)
    start = np.zeros((openings, ways, 3))
    start[..., 0] = d1[:, None]
    way = np.zeros_like(start)
    way[..., 1:] = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    near, far = np.zeros((openings, ways, 1)), np.full((openings, ways, 1), 40.0)
    for _ in range(30):
        middle = (near + far) / 2
        inside = rig.is_inside(start + middle * way)[..., None]
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    return start + near * way


def envelope(out: Path, folder: Path) -> Path:
    """Draw everywhere that the lower incisal point can go, with the captured motion inside."""
    rig = jawusd.load(out / "actor.usda")
    surface, captured = incisal_point(rig, border(rig)), incisal_point(rig, rig.captured_d)
    figure = Figure(figsize=(8.6, 4.4), layout="constrained")
    solid = figure.add_subplot(1, 3, 1, projection="3d")
    x, y, z = np.moveaxis(surface, -1, 0)
    solid.plot_surface(z, x, y, color=BLUE, alpha=0.25, linewidth=0, rcount=60, ccount=72)
    solid.plot(*captured[:, [2, 0, 1]].T, color=VERMILION, lw=0.8)
    solid.set_box_aspect([np.ptp(z), np.ptp(x), np.ptp(y)])
    solid.view_init(elev=16, azim=-28)
    solid.set(xlabel="forward", ylabel="left", zlabel="up", title="the envelope of motion [mm]")
    solid.locator_params(nbins=4)
    for place, (across, label, title) in enumerate(
        [(2, "forward [mm]", "from the side"), (0, "to the subject's left [mm]", "from the front")], start=2
    ):
        plane = figure.add_subplot(1, 3, place)
        a, b = surface[..., across], surface[..., 1]
        plane.pcolormesh(a, b, np.ones_like(a), shading="gouraud", cmap="Blues", vmin=0, vmax=3, rasterized=True)
        plane.plot(captured[:, across], captured[:, 1], color=VERMILION, lw=0.8)
        plane.set(xlabel=label, ylabel="up [mm]", title=title, aspect="equal")
        plane.spines[["top", "right"]].set_visible(False)
    figure.get_layout_engine().set(h_pad=0.12, w_pad=0.08)
    return save_webp(folder / "envelope.webp", drawn(figure), 1200)


def contacts(out: Path, folder: Path) -> Path:
    """Draw where teeth touch in the closed bite and in a glide to the left, as articulating paper marks them."""
    actor = out / "actor.usda"
    rig = jawusd.load(actor)
    view, left = ContactView(actor, rig, describe(actor)["prim"]), 0.6 * float(rig.ranges(0.0).d2_max)
    poses = {"closed bite": (0.0, 0.0, 0.0), f"gliding {left:.1f} mm to the left": (0.0, left, 0.0)}
    pictures = [Image.fromarray(view.draw(np.array(d))) for d in poses.values()]
    font, line = ImageFont.load_default(20), 44
    width, height = pictures[0].size
    sheet = Image.new("RGB", (width, 2 * (height + line) + line), "white")
    pen = ImageDraw.Draw(sheet)
    for k, (words, picture) in enumerate(zip(poses, pictures, strict=True)):
        sheet.paste(picture, (0, k * (height + line) + line))
        pen.text((width / 2, k * (height + line) + 12), words, fill="black", font=font, anchor="ma")
    at, below = 12, sheet.height - line + 12
    for mark in (*TOUCHING, DEEP):
        pen.rectangle((at, below, at + 20, below + 20), fill=mark.color)
        pen.text((at + 26, below + 10), mark.meaning, fill="black", font=font, anchor="lm")
        at += 48 + round(font.getlength(mark.meaning))
    return save_webp(folder / "contacts.webp", sheet, sheet.width)


def condyles(out: Path, folder: Path) -> Path:
    """Draw the path of the left condyle under the skull, after Fig. 5 of the paper."""
    found = run_paper_experiments(subject_of_build(out), load_tracks(out / "tracks.npz"), 1, no_progress, quick=True)
    return save_webp(folder / "condyles.webp", drawn(condyle_figure(found)), 1100)


@contextlib.contextmanager
def browser_page(size_px: tuple[int, int]) -> Iterator[Any]:
    """Yield an empty page of Chromium."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    program = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        raise NotInstalledError("playwright: pip install playwright") from None
    if program is None:
        raise NotInstalledError("Chromium: install it, or name it in CHROMIUM")
    arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        page = playwright.chromium.launch(executable_path=program, args=arguments).new_page(
            viewport=dict(zip(("width", "height"), size_px, strict=True)), reduced_motion="reduce"
        )
        page.set_default_timeout(PATIENCE_MS)
        yield page


def let_draw(page: Any) -> None:
    """Wait until the page has drawn what it was sent, on a busy machine too."""
    page.wait_for_timeout(DRAWN_MS)
    page.evaluate("new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)))")


@contextlib.contextmanager
def viewed(out: Path, size_px: tuple[int, int]) -> Iterator[tuple[Viewer, Any]]:
    """Open the page of `jawusd view` in Chromium, and yield its server and the page."""
    with browser_page(size_px) as page, contextlib.ExitStack() as stack:
        served = open_viewer(out, "127.0.0.1", 0, play=False)
        stack.callback(served.stop)
        page.goto(served.url)
        page.wait_for_selector("text=nearest captured")
        page.locator(".mantine-Notification-closeButton").first.click()  # "Software WebGL" lies over the jaw
        yield served, page


def pose_page(out: Path, folder: Path) -> Path:
    """Photograph the page of `jawusd view --page` with keys."""
    with tempfile.TemporaryDirectory() as made, browser_page((1440, 900)) as page:
        write_page(out, Path(made) / "jaw.html")
        page.goto((Path(made) / "jaw.html").as_uri())
        page.wait_for_selector("#jaw[data-clearance]", state="attached")  # scripts of the page must not use eval
        timeline = page.locator('[data-jaw="timeline"]')
        area, box = json.loads(timeline.get_attribute("data-area")), timeline.bounding_box()
        for share, d in KEYS_SHOWN:
            page.mouse.click(box["x"] + area["left"] + share * (area["right"] - area["left"]), box["y"] + 10)
            page.click('[data-jaw="close"]')
            for name, value in zip(("d1", "d2", "d3"), d, strict=True):
                slider = page.locator(f'[data-jaw="{name}"]')
                slider.evaluate("(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", value)
            page.click('[data-jaw="key"]')
        picture = page.screenshot()
    return save_webp(folder / "pose_page.webp", Image.open(io.BytesIO(picture)), 1200)


def report(out: Path, folder: Path) -> Path:
    """Photograph the top of the report of a build."""
    with browser_page((1200, 900)) as page:
        page.goto((out / "report.html").resolve().as_uri())
        let_draw(page)
        picture = page.screenshot()
    return save_webp(folder / "report.webp", Image.open(io.BytesIO(picture)), 1100)


def phone(out: Path, folder: Path) -> Path:
    """Photograph the page of `jawusd view --page` as a phone shows it."""
    with tempfile.TemporaryDirectory() as made, browser_page((390, 780)) as page:
        write_page(out, Path(made) / "jaw.html")
        page.goto((Path(made) / "jaw.html").as_uri())
        page.wait_for_selector("#jaw[data-clearance]", state="attached")
        page.locator('[data-jaw="d1"]').evaluate("(e) => { e.value = 16; e.dispatchEvent(new Event('input')); }")
        let_draw(page)
        picture = page.screenshot()
    return save_webp(folder / "phone.webp", Image.open(io.BytesIO(picture)), 390)


def footage(out: Path, folder: Path, frames: tuple[int, int] = FOOTAGE_FRAMES) -> Path:
    """Draw the teeth that are tracked in the example's footage without its masks."""
    with tempfile.TemporaryDirectory() as made:
        capture_of(Path(made) / "footage", frames, 3, masks=False)
        run_jawusd("track", Path(made) / "footage", "-o", Path(made) / "tracks.npz")
        capture, tracks = load_capture(Path(made) / "footage"), load_tracks(Path(made) / "tracks.npz")
        offsets, scans = sync_cameras(capture, no_progress)["offsets"], tracked_scans(capture, tracks)
        with contextlib.closing(open_wall(capture, offsets, tracks, scans, (400, 300))) as wall:
            row = len(tracks.frames) - 1
            picture = wall.draw(int(tracks.frames[row]), placed_scans(tracks, row, scans), fill=0.0)
    return save_webp(folder / "footage.webp", Image.fromarray(picture), 1200)


def viewer(out: Path, folder: Path) -> Path:
    """Photograph the page of `jawusd view` at a frame of the take, with its footage."""
    with viewed(out, (1440, 900)) as (served, page):
        (shown,) = served.pages.values()
        page.get_by_role("button", name="play", exact=True).click()
        page.get_by_role("button", name="pause", exact=True).click()
        page.get_by_role("button", name="play", exact=True).wait_for()
        shown.motion.show(float(VIEWED_FRAME))
        if shown.footage is not None:
            page.wait_for_selector("img:visible")
        let_draw(page)
        picture = page.screenshot()
    return save_webp(folder / "viewer.webp", Image.open(io.BytesIO(picture)), 1200)


def jaw(out: Path, folder: Path, step: int = STEP) -> Path:
    """Photograph a part of the captured take from one closed bite to the next, as a loop."""
    pictures = []
    (width, height), left = JAW_PX, PANELS_PX[0]
    with viewed(out, (width + sum(PANELS_PX), height)) as (served, page):
        actor = viewed_actor(out)
        clip = actor.load_clip(actor.take)
        (shown,) = served.pages.values()
        set_theme(shown.client.gui, dark=False)  # the first page of the documentation is light
        shown.scene.show_paths(False)
        target = preset_view(rest_places(actor.rig), "front")[0] + JAW_AIM_MM
        camera = shown.client.camera
        camera.position, camera.look_at = tuple(target + JAW_FROM_MM), tuple(target)
        for frame in range(*JAW_FRAMES, step):
            served.show(clip.at(frame))
            let_draw(page)
            picture = page.screenshot(clip={"x": left, "y": 0, "width": width, "height": height})
            pictures.append(Image.open(io.BytesIO(picture)).convert("RGB"))
    path = folder / "jaw.webp"
    pause_ms = round(1000 * step / clip.fps)
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=pause_ms, loop=0, quality=70, method=6)
    return path


def face_solver(out: Path, folder: Path) -> Path:
    """Compare a jaw rig as prior with the usual ones: examples/03_face_solver.py, on a synthetic person."""
    with tempfile.TemporaryDirectory() as plots:
        plot = Path(plots) / "face_solver.png"
        script = ROOT / "examples" / "03_face_solver.py"
        subprocess.run([sys.executable, script, "-o", plot], check=True, stdout=subprocess.DEVNULL)
        return save_webp(folder / "face_solver.webp", Image.open(plot), 990)


def blender(out: Path, folder: Path, frames: int = FRAMES) -> Path:
    """Render the captured motion in Blender, imported as it is."""
    python = Path(os.environ.get("JAWUSD_INTEROP", "")) / "blender45" / "bin" / "python"
    if "JAWUSD_INTEROP" not in os.environ or not python.exists():
        raise NotInstalledError("Blender: python tests/interop/make_environments.py FOLDER; set JAWUSD_INTEROP=FOLDER")
    path = folder / "blender.mp4"
    with tempfile.TemporaryDirectory() as pictures:
        script = Path(__file__).with_name("gallery_blender.py")
        command = [python, script, out / "anim_capture.usdc", pictures, FIRST, frames, STEP]
        subprocess.run(list(map(str, command)), check=True, stdout=subprocess.DEVNULL)
        images = [np.array(Image.open(file).convert("RGB")) for file in sorted(Path(pictures).glob("*.png"))]
    fps = load_capture(CAPTURE).fps / STEP
    with VideoWriter(path, images[0].shape[1::-1], fps, quality_crf=25) as video:
        for image in images:
            video.write(image)
    return path


def chart(draw: Callable[[Path], Figure]) -> Picture:
    """Return the function that makes the picture of a chart."""
    return lambda out, folder: save_webp(folder / f"{draw.__name__}.webp", drawn(draw(out)), 1100)


_MADE = (overlay, envelope, contacts, condyles, viewer, pose_page, phone, report, jaw, footage, face_solver, blender)
PICTURES: dict[str, Picture] = {made.__name__: made for made in _MADE} | {draw.__name__: chart(draw) for draw in CHARTS}


def main() -> int:
    """Make the pictures that were asked for; return 1 if a program was missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out"))
    parser.add_argument("--only", nargs="+", choices=PICTURES, default=list(PICTURES))
    parser.add_argument("-o", "--folder", type=Path, default=Path(__file__).parent / "gallery")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    missing = 0
    for name in options.only:
        try:
            path = PICTURES[name](options.out, options.folder)
            print(f"{path}: {path.stat().st_size / 1024:.0f} kB", flush=True)
        except NotInstalledError as needed:
            missing += 1
            print(f"{name}: not made, needs {needed}", flush=True)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
