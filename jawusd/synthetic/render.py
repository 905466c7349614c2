"""Render the synthetic scene with OpenGL: colour images and exact teeth masks through distorted lenses.

The scene is rendered without distortion at a multiple of the image size. Every pixel of the image then samples this
rendering along its distorted ray, so that straight edges bend as in a real lens.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources

import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import MissingDependencyError
from jawusd.geometry import Camera, se3_inverse
from jawusd.meshes.surfaces import vertex_normals
from jawusd.synthetic.anatomy import Surface

NEAR_MM, FAR_MM = 80.0, 700.0
#: Labels of surfaces; surfaces of every label can occlude the teeth.
OTHER, UPPER_TEETH, LOWER_TEETH = 0, 1, 2
_NOTHING = 9.0
_SCALE = 2
_BEND_STEP_PX = 16
_BACKDROP = (0.035, 0.050, 0.066)


@dataclass(frozen=True, eq=False)
class Picture:
    """One rendered image."""

    color: NDArray[np.uint8]  # colour image, sRGB-like, shape (h, w, 3)
    # coverage of each pixel by visible upper and lower teeth, 0..255, shape (h, w)
    upper: NDArray[np.uint8]
    lower: NDArray[np.uint8]


class Renderer:
    """Renderer of named surfaces for cameras of one image size; as a context manager, it frees its GL context."""

    def __init__(self, cameras: list[Camera]) -> None:
        """Open a headless GL context and prepare the cameras, which must have the same image size.

        Raises:
            MissingDependencyError: EGL or its driver is missing.
            ValueError: the cameras differ in image size.
        """
        if len({camera.size_px for camera in cameras}) != 1:
            raise ValueError(f"all cameras must have the same image size, got {[camera.size_px for camera in cameras]}")
        self._gl = _context()
        self._cameras = cameras
        self._size = cameras[0].size_px
        self._parts: dict[str, _Part] = {}
        self._margin = 16 + int(0.01 * max(self._size)) * _SCALE
        width, height = (_SCALE * s + 2 * self._margin for s in self._size)
        self._scene_size = (width, height)
        self._scene_program = self._program("scene.vert", "scene.frag")
        self._shadow_program = self._program("screen.vert", "shadow.frag")
        self._lens_program = self._program("screen.vert", "lens.frag")
        self._make_targets()
        self._grain = self._grain_texture()
        self._bends = [self._bend_texture(camera) for camera in cameras]
        self._jitters: dict[str, moderngl.Texture] = {}

    def _program(self, vertex: str, fragment: str) -> moderngl.Program:
        """Compile a program from the files of its vertex and fragment shader."""
        folder = resources.files("jawusd.synthetic") / "shaders"
        first, second = ((folder / name).read_text(encoding="utf-8") for name in (vertex, fragment))
        return self._gl.program(first, second)

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self._gl.release()

    def add(self, name: str, surface: Surface, label: int = OTHER) -> None:
        """Add or replace a surface, given in its own frame; the label is `UPPER_TEETH`, `LOWER_TEETH` or `OTHER`."""
        with self._gl:
            self._parts[name] = _Part(self._gl, self._scene_program, surface, label)

    def move(self, name: str, vertices: Array) -> None:
        """Set the vertex positions (V, 3) [mm] of a surface."""
        with self._gl:
            self._parts[name].write(vertices)

    def render(
        self,
        camera: int,
        T_world_part: dict[str, Array],
        T_world_head: ArrayLike,
        light: float = 1.0,
        jitter_px: tuple[Array, Array] | None = None,
    ) -> Picture:
        """Render an image of a camera, given by its index.

        Args:
            T_world_part: poses of the surfaces to draw, (4, 4) each; other surfaces are hidden.
            T_world_head: pose of the skull, shape (4, 4); shading uses the depth inside the mouth in the skull frame.
            light: brightness factor.
            jitter_px: displacement fields of the upper and the lower mask [px], (gh, gw, 2) each, stretched over the
                image.
        """
        with self._gl:
            self._draw_scene(self._cameras[camera], T_world_part, T_world_head, light)
            self._draw_shadow(self._cameras[camera])
            return self._draw_lens(camera, light, jitter_px)

    def _draw_scene(self, view: Camera, T_world_part: dict[str, Array], T_world_head: ArrayLike, light: float) -> None:
        program = self._scene_program
        _write(program, "clip_from_world", self._projection(view) @ view.T_cam_world)
        _write(program, "head_from_world", se3_inverse(T_world_head))
        program["eye"] = tuple(view.centre_world())
        program["light"] = light
        self._grain.use(0)
        program["grain"] = 0
        self._scene.use()
        self._gl.enable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        self._scene.clear(0.0, 0.0, 0.0, _NOTHING, depth=1.0)
        for name, T in T_world_part.items():
            part = self._parts[name]
            _write(program, "world_from_part", T)
            program["label"] = float(part.label)
            program["freckles"] = part.freckles
            part.vao.render()
        self._gl.disable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)

    def _draw_shadow(self, view: Camera) -> None:
        self._depth.use(0)
        self._shadow_program["depth"] = 0
        self._shadow_program["planes_mm"] = (NEAR_MM, FAR_MM)
        self._shadow_program["texel"] = (1.0 / self._scene_size[0], 1.0 / self._scene_size[1])
        self._shadow_program["focal_px"] = float(view.K[0, 0] * _SCALE)
        self._shadow.use()
        self._shadow_quad.render(moderngl.TRIANGLE_STRIP)

    def _draw_lens(self, camera: int, light: float, jitter_px: tuple[Array, Array] | None) -> Picture:
        program = self._lens_program
        still = np.zeros((2, 2, 2))
        upper, lower = (still, still) if jitter_px is None else jitter_px
        textures = (
            ("scene", self._color),
            ("shadow", self._shadow_texture),
            ("bend_px", self._bends[camera]),
            ("jitter_upper_px", self._jitter_texture("upper", upper)),
            ("jitter_lower_px", self._jitter_texture("lower", lower)),
        )
        for unit, (name, texture) in enumerate(textures):
            texture.use(unit)
            program[name] = unit
        program["size_px"] = tuple(float(s) for s in self._size)
        program["to_scene"] = (float(_SCALE), float(self._margin))
        program["scene_size_px"] = tuple(float(s) for s in self._scene_size)
        program["backdrop"] = tuple(light * c for c in _BACKDROP)
        self._picture.use()
        self._lens_quad.render(moderngl.TRIANGLE_STRIP)
        width, height = self._size
        color = np.frombuffer(self._picture.read(components=3, attachment=0, alignment=1), np.uint8)
        masks = np.frombuffer(self._picture.read(components=2, attachment=1, alignment=1), np.uint8)
        masks = masks.reshape(height, width, 2)
        return Picture(color.reshape(height, width, 3), masks[..., 0].copy(), masks[..., 1].copy())

    def _make_targets(self) -> None:
        gl, (width, height) = self._gl, self._scene_size
        self._color = gl.texture((width, height), 4, dtype="f2")
        self._color.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._depth = gl.depth_texture((width, height))
        self._depth.compare_func = ""
        self._depth.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._scene = gl.framebuffer([self._color], self._depth)
        self._shadow_texture = gl.texture((width // 4, height // 4), 1)
        self._shadow = gl.framebuffer([self._shadow_texture])
        self._picture = gl.framebuffer([gl.texture(self._size, 4), gl.texture(self._size, 2)])
        corners = gl.buffer(np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], dtype=np.float32).tobytes())
        self._shadow_quad = gl.vertex_array(self._shadow_program, [(corners, "2f", "in_corner")])
        self._lens_quad = gl.vertex_array(self._lens_program, [(corners, "2f", "in_corner")])

    def _projection(self, view: Camera) -> Array:
        """Return the OpenGL clip matrix of the enlarged and padded pinhole image, whose first row is at the top."""
        (width, height), m = self._scene_size, self._margin
        K = np.diag([_SCALE, _SCALE, 1.0]) @ view.K  # centres of image pixels coincide with centres of scene pixels
        out = np.zeros((4, 4))
        out[0] = [2 * K[0, 0] / width, 2 * K[0, 1] / width, 2 * (K[0, 2] + m + 0.5) / width - 1, 0]
        out[1] = [0, 2 * K[1, 1] / height, 2 * (K[1, 2] + m + 0.5) / height - 1, 0]
        spread = FAR_MM - NEAR_MM
        out[2] = [0, 0, (FAR_MM + NEAR_MM) / spread, -2 * FAR_MM * NEAR_MM / spread]
        out[3, 2] = 1.0
        return out

    def _bend_texture(self, camera: Camera) -> moderngl.Texture:
        """Return the displacement from recorded to pinhole pixels on a coarse grid; shaders interpolate it linearly."""
        width, height = self._size
        columns, rows = -(-width // _BEND_STEP_PX), -(-height // _BEND_STEP_PX)
        # Centres of the texels, in image pixels.
        x = (np.arange(columns) + 0.5) * width / columns - 0.5
        y = (np.arange(rows) + 0.5) * height / rows - 0.5
        pixels = np.stack(np.meshgrid(x, y), -1)
        return self._vector_texture(camera.undistort_pixels(pixels) - pixels)

    def _jitter_texture(self, name: str, field: ArrayLike) -> moderngl.Texture:
        field = np.asarray(field, dtype=np.float32)
        texture = self._jitters.get(name)
        if texture is None or texture.size != (field.shape[1], field.shape[0]):
            if texture is not None:
                texture.release()
            self._jitters[name] = self._vector_texture(field)
        else:
            texture.write(field.tobytes())
        return self._jitters[name]

    def _grain_texture(self) -> moderngl.Texture3D:
        """Return a cube of smooth periodic noise and its gradient, for the skin texture."""
        n = 64
        rng = np.random.default_rng(0x5C1)
        frequency = np.fft.fftfreq(n) * n
        radius = np.sqrt(sum(f**2 for f in np.meshgrid(frequency, frequency, frequency, indexing="ij")))
        spectrum = np.fft.fftn(rng.normal(size=(n, n, n))) * np.exp(-((radius / 14.0) ** 2))
        value = np.fft.ifftn(spectrum).real
        fields = np.stack([value, *np.gradient(value)[::-1]], -1)  # the axes in memory are z, y, x
        fields = 0.5 + 0.16 * fields / fields.std((0, 1, 2))
        texels = (255 * np.clip(fields, 0.0, 1.0)).astype(np.uint8)
        texture = self._gl.texture3d((n, n, n), 4, texels.tobytes())
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        return texture

    def _vector_texture(self, field: Array) -> moderngl.Texture:
        rows, columns, _ = field.shape
        texture = self._gl.texture((columns, rows), 2, field.astype(np.float32).tobytes(), dtype="f4")
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        texture.repeat_x = texture.repeat_y = False
        return texture


class _Part:
    """GPU buffers of one surface."""

    def __init__(self, gl: moderngl.Context, program: moderngl.Program, surface: Surface, label: int) -> None:
        self.label, self.freckles = label, surface.freckles
        self._faces = surface.faces
        fixed = np.concatenate(
            [surface.colors, np.stack([surface.gloss, surface.skin, surface.inside], -1), surface.vertices], axis=1
        )
        self._moving = gl.buffer(reserve=len(surface.vertices) * 24)
        self.write(surface.vertices)
        self.vao = gl.vertex_array(
            program,
            [
                (self._moving, "3f 3f", "in_position", "in_normal"),
                (gl.buffer(_bytes(fixed)), "3f 3f 3f", "in_color", "in_material", "in_rest"),
            ],
            gl.buffer(np.ascontiguousarray(surface.faces, dtype=np.int32).tobytes()),
        )

    def write(self, vertices: Array) -> None:
        """Upload vertex positions and the corresponding normals."""
        normals = vertex_normals(vertices, self._faces)
        self._moving.write(_bytes(np.concatenate([vertices, normals], axis=1)))


def _write(program: moderngl.Program, name: str, matrix: Array) -> None:
    """Set a matrix uniform; GL expects column-major order."""
    uniform = program[name]
    if isinstance(uniform, moderngl.Uniform):
        uniform.write(_bytes(matrix.T))


def _bytes(array: ArrayLike) -> bytes:
    return np.ascontiguousarray(array, dtype=np.float32).tobytes()


def _context() -> moderngl.Context:
    """Return a headless GL 3.3 context on EGL."""
    try:
        context = moderngl.create_standalone_context(backend="egl", require=330)  # type: ignore[arg-type]  # backend is a name
    except Exception as error:  # moderngl raises bare exceptions with the loader's text
        raise MissingDependencyError(
            f"rendering needs OpenGL 3.3 through EGL, which failed to start ({error}).",
            hint="Install it, on Debian or Ubuntu: apt-get install libegl1 libgl1 libgl1-mesa-dri",
        ) from error
    context.front_face = "cw"  # images are rendered with their first row at the bottom of the render target
    return context
