"""The drawings of the documentation, as SVG in the text of a page. As files: python docs/hooks/figures.py FOLDER."""

import math
import sys
from pathlib import Path


def svg(width, height, label, parts):
    """Return an SVG of the given size; the label is what screen readers say."""
    head = f'<svg class="drawing" viewBox="0 0 {width} {height}" role="img" aria-label="{label}">'
    return head + "".join(parts) + "</svg>"


def smooth(points, kind="line"):
    """Return a curve that begins and ends at the outer points and rounds the corners at all others."""
    middles = [((a + c) / 2, (b + d) / 2) for (a, b), (c, d) in zip(points, points[1:])]
    d = f"M{points[0][0]:g} {points[0][1]:g} L{middles[0][0]:g} {middles[0][1]:g}"
    for (x, y), (u, v) in zip(points[1:-1], middles[1:]):
        d += f" Q{x:g} {y:g} {u:g} {v:g}"
    return f'<path d="{d} L{points[-1][0]:g} {points[-1][1]:g}" class="{kind}"/>'


def text(x, y, words, anchor="middle", kind=""):
    """Return words at a place."""
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" class="{kind}">{words}</text>'


def path(points, kind="line", closed=False):
    """Return a line through points."""
    d = "M" + " L".join(f"{x:.1f} {y:.1f}" for x, y in points) + (" Z" if closed else "")
    return f'<path d="{d}" class="{kind}"/>'


def circle(x, y, radius, kind="soft"):
    """Return a circle."""
    return f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" class="{kind}"/>'


def box(x, y, width, height, kind="soft", corner=4):
    """Return a rectangle."""
    return f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="{corner}" class="{kind}"/>'


def arrow(start, end, kind="line"):
    """Return a line with a head at its end."""
    (x0, y0), (x1, y1) = start, end
    angle = math.atan2(y1 - y0, x1 - x0)
    wings = [(x1 - 10 * math.cos(angle + s), y1 - 10 * math.sin(angle + s)) for s in (0.45, -0.45)]
    return path([start, end], kind) + path([wings[0], end, wings[1]], kind)


def camera(x, y, angle_deg, name):
    """Return a camera seen from above that looks along an angle."""
    a = math.radians(angle_deg)
    corners = [(-26, -11), (0, -11), (0, -5), (12, -9), (12, 9), (0, 5), (0, 11), (-26, 11)]
    turned = [(x + u * math.cos(a) - v * math.sin(a), y + u * math.sin(a) + v * math.cos(a)) for u, v in corners]
    return path(turned, "soft", closed=True) + text(x - 44 * math.cos(a), y - 44 * math.sin(a) + 5, name)


def cameras():
    """Draw where cameras and lights stand, seen from above."""
    mouth, far = (340.0, 120.0), 190.0
    parts = [circle(340, 62, 58), text(340, 60, "head"), path([(334, 119), (340, 130), (346, 119)])]
    for angle, name in ((-38.0, "right"), (0.0, "front"), (37.0, "left")):
        a = math.radians(90.0 - angle)
        x, y = mouth[0] + far * math.cos(a), mouth[1] + far * math.sin(a)
        parts += [path([mouth, (x, y)], "thin"), camera(x, y, math.degrees(a) + 180.0, name)]
    for x in (95.0, 585.0):
        parts += [box(x - 34, 150, 68, 20), text(x, 196, "soft light")]
    arc = [(mouth[0] + 95 * math.cos(t), mouth[1] + 95 * math.sin(t)) for t in (math.radians(d) for d in range(53, 91))]
    parts += [path(arc, "one"), text(404, 234, "about 40&#176;", "start", "small")]
    parts += [text(330, 268, "about 0.2 m", "end", "small")]
    return svg(680, 380, "Three cameras around the mouth, seen from above, with soft lights on both sides", parts)


def exercises():
    """Draw the exercises of a take over time: opening, laterotrusion and protrusion."""
    plan = [
        ("teeth together", 2, (0, 0, 0)),
        ("open wide, slowly, three times", 9, (1, 0, 0)),
        ("to the left and right", 5, (0, 1, 0)),
        ("forward", 4, (0, 0, 1)),
        ("half open: left, right, forward", 6, (0.45, 1, 0.7)),
        ("along the limits", 5, (0.9, 0.8, 0.3)),
        ("chew and speak", 5, (0.3, 0.25, 0.1)),
        ("teeth together", 2, (0, 0, 0)),
    ]
    scale, left, curves, parts, at = 14.7, 90.0, ([], [], []), [], 0.0
    for row, (name, seconds, sizes) in enumerate(plan):
        x = left + at * scale
        parts += [path([(x, 20), (x, 262)], "thin"), text(x + seconds * scale / 2, 16, str(row + 1))]
        for k in range(41):
            t = k / 40
            turns = 3 if "chew" in name or "three" in name else 1
            swing = 0.5 - 0.5 * math.cos(2 * math.pi * turns * t)
            sides = math.sin(2 * math.pi * turns * t)
            held = min(1.0, 5 * t, 5 * (1 - t)) if "half" in name or "limits" in name else swing
            values = (sizes[0] * held, sizes[1] * sides, sizes[2] * (held * abs(sides) if "half" in name else swing))
            for curve, value in zip(curves, values):
                curve.append((x + t * seconds * scale, value))
        at += seconds
    for curve, kind, base, name in zip(curves, ("one", "two", "three"), (90, 160, 250), ("opening", "side", "forward")):
        high = 55 if base != 160 else 34
        parts += [path([(x, base - high * v) for x, v in curve], kind), text(left - 12, base, name, "end")]
    for row, (name, seconds, _) in enumerate(plan):
        column, line = divmod(row, 4)
        parts.append(text(100 + 300 * column, 292 + 20 * line, f"{row + 1}  {name}, {seconds} s", "start", "small"))
    return svg(680, 362, "Exercises of a take over time: opening, laterotrusion and protrusion", parts)


def crown(x, top, width, height, up):
    """Return the outline of a crown; `up` points from the edge to the gum."""
    s = -1 if up else 1
    return [
        (x + 0.15 * width, top), (x, top - s * 0.6 * height), (x + 0.06 * width, top - s * height),
        (x + 0.94 * width, top - s * height), (x + width, top - s * 0.6 * height), (x + 0.85 * width, top),
    ]  # fmt: skip


def masks():
    """Draw what masks of both rows hold: crowns, from the gum line to the tooth edges, behind the lips or not."""
    parts = []
    for side, label in ((0, "the picture"), (350, "its two masks")):
        for row in range(2):
            edge = 118 if row == 0 else 150
            for k in range(6):
                x, width, height = side + 52 + 37 * k, 36, 52 - 3 * abs(k - 2.5)
                height = height if row == 0 else 0.75 * height
                gum_line = edge - height if row == 0 else edge + height
                if not side:
                    parts.append(box(x, gum_line - 22 if row == 0 else gum_line, width, 22, "gum"))
                kind = "soft" if not side else "area"
                parts.append(path(crown(x, gum_line, width, height, up=row == 0), kind, closed=True))
        parts.append(text(side + 163, 250, label))
    parts += [text(338, 66, "gum line", "middle", "small"), text(338, 138, "tooth edges", "middle", "small")]
    parts += [arrow((308, 68), (276, 72)), arrow((372, 68), (400, 72)), arrow((300, 134), (276, 122))]
    parts += [text(513, 40, "upper", "middle", "small"), text(513, 222, "lower", "middle", "small")]
    return svg(680, 264, "Crowns in the picture, and the masks of the upper and the lower row", parts)


def board():
    """Draw where the calibration board is held: at the place of the teeth, near and far, tilted."""
    parts = [path([(70, 60), (300, 150)], "thin"), path([(70, 240), (300, 150)], "thin"), camera(70, 60, 21, "")]
    parts += [camera(70, 240, -21, ""), camera(60, 150, 0, ""), path([(60, 150), (300, 150)], "thin")]
    for x, y, tilt in ((260, 150, 0), (300, 138, 22), (340, 158, -22), (380, 150, 8)):
        a = math.radians(90 + tilt)
        parts.append(path([(x - 46 * math.cos(a), y - 46 * math.sin(a)), (x + 46 * math.cos(a), y + 46 * math.sin(a))]))
    parts.append(text(320, 232, "the board, where the teeth will be:"))
    parts.append(text(320, 252, "near, far, tilted in every direction"))
    for i in range(7):
        for j in range(5):
            if (i + j) % 2 == 0:
                parts.append(box(470 + 24 * i, 80 + 24 * j, 24, 24, "square", 0))
    parts += [box(460, 70, 188, 140, "line"), text(554, 236, "chessboard: inner corners count"), ]  # fmt: skip
    parts += [text(554, 256, "cols = 6, rows = 4", "middle", "small")]
    return svg(680, 290, "The calibration board is shown to all cameras where the teeth will be", parts)


def turn(x, y, degrees):
    """Return a point turned about the condyle, which slides forward and down as the mouth opens."""
    a = math.radians(degrees)
    u, v = x - 64, y - 66
    return 64 + u * math.cos(a) - v * math.sin(a) + 9, 66 + u * math.sin(a) + v * math.cos(a) + 6


def teeth(x, y, count, lower):
    """Return crowns in a row, as outlines."""
    return [path(crown(x + 18 * k, y + (30 if lower else 0), 17, 28, not lower), "soft", True) for k in range(count)]


def parameters():
    """Draw the three parameters at the lower incisal point, seen from the side and from the front."""
    skull = [(30, 58), (52, 46), (80, 58), (96, 50), (150, 62), (230, 70), (262, 74)]
    parts = [smooth(skull), *teeth(176, 72, 5, False)]
    jaw = [(66, 66), (58, 84), (72, 120), (84, 156), (120, 166), (200, 164), (262, 160), (270, 136), (262, 112)]
    turned = [turn(x, y, 14.0) for x, y in jaw]
    parts += [smooth(jaw, "thin"), smooth(turned), circle(64, 66, 9, "thin"), circle(*turn(64, 66, 14.0), 9)]
    start, end = (266, 104), turn(266, 104, 14.0)
    parts += [text(50, 34, "condyle"), arrow(start, end, "one"), circle(*start, 4, "fill1")]
    parts += [text(end[0] + 16, end[1] - 14, "d1 opening", "start"), arrow(start, (326, 104), "three")]
    parts += [text(334, 109, "d3 protrusion", "start"), text(278, 88, "lower incisal point", "start", "small")]
    parts.append(text(170, 262, "from the side"))
    front = 560
    parts += [*teeth(front - 54, 66, 6, False), *teeth(front - 54, 122, 6, True), circle(front, 112, 4, "fill2")]
    parts.append(smooth([(front - 88, 76), (front - 80, 140), (front - 50, 184), (front, 196), (front + 50, 184),
                         (front + 80, 140), (front + 88, 76)]))  # fmt: skip
    parts += [arrow((front, 112), (front + 62, 112), "two"), text(front, 222, "d2, to the subject's left")]
    parts.append(text(front, 262, "from the front"))
    return svg(680, 280, "Opening d1 and protrusion d3 from the side, laterotrusion d2 from the front", parts)


def stages():
    """Draw the stages of a build and what each hands on."""
    names = (
        ("sync", "offsets of cameras"), ("track", "poses of both rows"), ("fit", "model and bound"),
        ("refine", "hard frames again"), ("bake", "OpenUSD rig"),
    )  # fmt: skip
    parts = []
    for k, (name, what) in enumerate(names):
        x = 16 + 133 * k
        parts += [box(x, 40, 112, 46), text(x + 56, 68, name), text(x + 56, 108, what, "middle", "small")]
        if k:
            parts.append(arrow((x - 20, 63), (x - 2, 63)))
    parts += [path([(471, 40), (471, 20), (205, 20), (205, 36)], "thin"), text(338, 14, "", "middle", "small")]
    return svg(680, 126, "The stages of a build: sync, track, fit, refine, bake", parts)


def bound():
    """Draw a section of the bound, with margins inside and outside."""
    points = []
    for k in range(72):
        a = 2 * math.pi * k / 72
        r = 1 + 0.12 * math.cos(2 * a) - 0.14 * math.sin(a)
        points.append((230 + 130 * r * math.cos(a), 145 + 88 * r * math.sin(a)))
    parts = [path(points, "area", closed=True)]
    parts += [path([(60, 165), (430, 165)], "thin"), path([(230, 20), (230, 270)], "thin")]
    parts += [text(430, 182, "d2", "end"), text(240, 32, "d3", "start")]
    parts += [circle(280, 120, 5, "fill3"), text(240, 146, "inside: margin +2.1 mm", "start", "small")]
    parts += [circle(430, 72, 5, "fill2"), text(444, 70, "outside: margin -2.9 mm", "start", "small")]
    parts += [arrow((430, 72), (362, 104), "two"), text(444, 90, "moved to the nearest valid d", "start", "small")]
    parts += [text(230, 292, "section of the bound at one opening d1")]
    return svg(680, 304, "A section of the bound in d2 and d3, with one point inside and one outside", parts)


def frames():
    """Draw the anatomical frame at the upper incisal point, and the origin of image coordinates."""
    parts = [smooth([(40, 60), (70, 44), (120, 52), (200, 62), (262, 74)]), *teeth(176, 72, 5, False)]
    parts += [arrow((266, 100), (266, 20), "one"), text(276, 26, "y, up", "start")]
    parts += [arrow((266, 100), (352, 100), "three"), text(330, 122, "z, forward", "start")]
    parts += [circle(266, 100, 7, "line"), *(path([(261, y), (271, 200 - y)], "two") for y in (95, 105))]
    parts += [text(256, 128, "x, to the left,", "end", "small"), text(256, 144, "away from the viewer", "end", "small")]
    parts.append(text(284, 92, "upper incisal point", "start", "small"))
    parts.append(text(200, 214, "anatomical frame, from the right"))
    for i in range(4):
        for j in range(3):
            parts.append(box(470 + 40 * i, 60 + 40 * j, 40, 40, "soft" if (i + j) % 2 else "line", 0))
    parts += [circle(490, 80, 4, "fill2"), text(470, 48, "(0, 0): centre of the first pixel", "start", "small")]
    parts += [arrow((490, 80), (566, 80), "two"), text(572, 85, "x", "start")]
    parts += [arrow((490, 80), (490, 156), "two"), text(490, 172, "y"), text(560, 214, "pixels of an image")]
    return svg(680, 232, "Axes at the upper incisal point: left, up, forward; pixels count from their centres", parts)


def threshold():
    """Draw how one threshold was chosen: the values of valid takes, those with a planted fault, and the gap."""
    x = lambda value: 40 + 30 * value  # noqa: E731
    parts = [path([(x(0), 110), (x(20), 110)])]
    for value in range(0, 21, 5):
        parts += [path([(x(value), 110), (x(value), 116)]), text(x(value), 132, str(value), "middle", "small")]
    parts += [box(x(0), 70, x(5.2) - x(0), 40, "area", 0), text(x(2.6), 60, "13 valid takes: at most 5.2")]
    parts += [box(x(13.6), 70, x(19) - x(13.6), 40, "soft", 0), text(x(16.3), 60, "3 knocked cameras: 13.6 to 19")]
    parts += [path([(x(8), 30), (x(8), 110)], "two"), text(x(8), 22, "threshold 8: the camera was knocked")]
    parts.append(text(340, 158, "motion of a camera since its calibration [standard deviations]"))
    return svg(680, 172, "A threshold between the values of valid takes and those of takes with a fault", parts)


def shot():
    """Draw the layers of a shot: the layer of rebake over the animation, over the rigs."""
    rows = (
        ("shot.usda", "the shot: what it holds wins over its sublayers"),
        ("jaws.usdc", "jawusd rebake: d and the mandible agree, inside the bound"),
        ("anim_take.usdc", "jawusd animate: d and plain transforms, frame by frame"),
        ("actor.usda", "the rig: meshes, model, bound"),
    )
    parts = [arrow((20, 190), (20, 24)), text(34, 18, "stronger", "start", "small")]
    for k, (name, words) in enumerate(rows):
        y = 30 + 42 * k
        parts += [box(40, y, 170, 32, "area" if k == 1 else "soft"), text(125, y + 21, name)]
        parts.append(text(228, y + 21, words, "start", "small"))
    return svg(680, 206, "Layers of a shot, the strongest on top: shot, jaws of rebake, animation, rig", parts)


FIGURES = {
    "cameras": cameras, "exercises": exercises, "masks": masks, "board": board, "parameters": parameters,
    "stages": stages, "bound": bound, "frames": frames, "threshold": threshold, "shot": shot,
}  # fmt: skip

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    style = (Path(__file__).parents[1] / "style.css").read_text().replace("var(--md-default-fg-color)", "#222")
    for name, draw in FIGURES.items():
        drawn = draw().replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
        (folder / f"{name}.svg").write_text(drawn.replace(">", f"><style>{style}</style>", 1))
