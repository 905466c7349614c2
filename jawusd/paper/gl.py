"""GPU pixel counter, which renders many poses and views into one layered texture and counts their pixels.

It needs OpenGL 4.3 through EGL, but no display; a software driver (llvmpipe) is sufficient. Counts may differ slightly
from those of the CPU where a pixel centre lies within rounding error of a triangle's edge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import JawusdError, MissingDependencyError
from jawusd.paper.energy import PaperScan, checked_screens

try:
    import moderngl
except ModuleNotFoundError as error:
    raise MissingDependencyError(
        'drawing on the GPU needs the package "moderngl", which is not installed.',
        hint="Install it with: pip install 'jawusd[all]', or use the CPU backend.",
    ) from error


_LAYER_EXTENSION = "GL_ARB_shader_viewport_layer_array"
_MOST_PIXELS = 1 << 26  # maximum number of pixels in one layered texture, 64 MB
_TILE_PX = 64  # side of the square tile in which one work group of 16 x 16 threads counts pixels
_ROUND_PX = 64  # texture sizes [px] are rounded up to a multiple of this number, so that frames can share textures

_VERTEX = f"""#version 430
#extension {_LAYER_EXTENSION} : require
in vec3 position;
layout(std430, binding = 0) readonly buffer Matrices {{ mat4 clip_from_scan[]; }};
void main() {{
    gl_Position = clip_from_scan[gl_InstanceID] * vec4(position, 1.0);
    gl_Layer = gl_InstanceID;
}}
"""

_FRAGMENT = """#version 430
uniform float shade;
out float colour;
void main() { colour = shade; }
"""

_COUNT = f"""#version 430
layout(local_size_x = 16, local_size_y = 16) in;
uniform sampler2DArray drawn;
uniform usampler2DArray masks;
uniform int views;
uniform ivec2 size;
layout(std430, binding = 1) buffer Counts {{ uint counts[]; }};
shared uint bare, outside;
void main() {{
    if (gl_LocalInvocationIndex == 0u) {{ bare = 0u; outside = 0u; }}
    barrier();
    int layer = int(gl_WorkGroupID.z);
    ivec2 corner = ivec2(gl_WorkGroupID.xy) * {_TILE_PX} + ivec2(gl_LocalInvocationID.xy);
    uint a = 0u, b = 0u;
    for (int y = corner.y; y < min(size.y, corner.y + {_TILE_PX}); y += 16)
        for (int x = corner.x; x < min(size.x, corner.x + {_TILE_PX}); x += 16) {{
            float shade = texelFetch(drawn, ivec3(x, y, layer), 0).r;
            uint mask = texelFetch(masks, ivec3(x, y, layer % views), 0).r;
            if (mask == 1u && shade < 0.25) a++;
            if (mask == 0u && shade > 0.75) b++;
        }}
    atomicAdd(bare, a);
    atomicAdd(outside, b);
    barrier();
    if (gl_LocalInvocationIndex == 0u) {{
        atomicAdd(counts[2 * layer], bare);
        atomicAdd(counts[2 * layer + 1], outside);
    }}
}}
"""


def open_context() -> moderngl.Context:
    """Open a windowless OpenGL 4.3 context bound to the calling thread; the caller must release it.

    Raises:
        MissingDependencyError: EGL, a driver, or an extension of the driver is missing.
    """
    try:
        # moderngl annotates every keyword with the type of the whole settings dictionary.
        context = moderngl.create_standalone_context(backend="egl", require=430)  # type: ignore[arg-type]  # a name
    except Exception as error:  # moderngl raises bare exceptions with the loader's text
        raise MissingDependencyError(
            f"drawing on the GPU needs OpenGL 4.3 through EGL, which did not start ({error}).",
            hint="On Debian or Ubuntu, install it with: apt-get install libegl1 libgl1 libgl1-mesa-dri. Otherwise, "
            "install the graphics card's driver, or use the CPU backend.",
        ) from error
    if _LAYER_EXTENSION not in context.extensions:
        renderer = context.info["GL_RENDERER"]
        context.release()
        raise MissingDependencyError(
            f'the OpenGL driver "{renderer}" lacks {_LAYER_EXTENSION}.',
            hint="Update the graphics driver, or use the CPU backend.",
        )
    return context


def describe_graphics() -> str:
    """Return the OpenGL version and renderer, or the reason why OpenGL cannot be used."""
    try:
        context = open_context()
    except JawusdError as error:
        return f"none ({error.message.rstrip('.')})"
    try:
        return f"{context.info['GL_VERSION']}, {context.info['GL_RENDERER']}"
    finally:
        context.release()


class GlCounter:
    """Pixel counter on the GPU; releasing the context frees its memory.

    Counters may share a context. All calls must come from the thread that opened the context.
    """

    def __init__(self, context: moderngl.Context, scan: PaperScan) -> None:
        self._gl = context
        self._flags = moderngl.CULL_FACE if scan.cull else moderngl.NOTHING
        self._program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._compute = context.compute_shader(_COUNT)
        self._compute["drawn"], self._compute["masks"] = 0, 1
        buffer = context.buffer(np.ascontiguousarray(scan.vertices, np.float32))
        # The boundary is drawn after the other teeth and overwrites them, so no depth buffer is needed.
        self._passes = []
        for shade, faces in ((0.5, scan.plain_faces), (1.0, scan.boundary_faces)):
            if len(faces):
                index = context.buffer(np.ascontiguousarray(faces, np.int32))
                array = context.vertex_array(self._program, [(buffer, "3f", "position")], index)
                self._passes.append((shade, array))
        self._targets: dict[int, tuple[moderngl.TextureArray, moderngl.Framebuffer]] = {}
        self._masks: moderngl.TextureArray | None = None
        self._most_layers = int(context.info["GL_MAX_ARRAY_TEXTURE_LAYERS"])

    def show(self, matrices: Array, masks: Mask) -> None:
        """Set masks of one frame as `RasterCounter.show` does; raises ValueError if too large for the device."""
        checked_screens(matrices, masks)
        views, height, width = masks.shape
        size = (-(-width // _ROUND_PX) * _ROUND_PX, -(-height // _ROUND_PX) * _ROUND_PX)
        if size[0] * size[1] * views > _MOST_PIXELS or views > self._most_layers:
            raise ValueError(f"{views} masks of {width} x {height} px exceed the maximum size of a texture")
        if self._masks is None or self._masks.size != (*size, views):
            self._drop_textures()
            self._masks = self._gl.texture_array((*size, views), 1, dtype="u1")
            self._masks.filter = (moderngl.NEAREST, moderngl.NEAREST)
        # Pixels of the padding, 2, are not counted.
        flags = np.full((views, size[1], size[0]), 2, np.uint8)
        flags[:, :height, :width] = masks
        self._masks.write(flags, alignment=1)
        # Pixel to clip coordinates, x_ndc = (2 u + 1) / w - 1, without depth; image row 0 becomes row 0 of the render
        # target.
        to_clip = np.array([[2 / size[0], 0, 1 / size[0] - 1], [0, 2 / size[1], 1 / size[1] - 1], [0, 0, 0], [0, 0, 1]])
        self._to_clip = to_clip @ np.asarray(matrices, np.float64)

    def counts(self, poses: Array) -> NDArray[np.int64]:
        """Return the counts of poses as `RasterCounter.counts` does, shape (N, C, 2)."""
        width, height, views = self._shown().size
        most = max(1, min(self._most_layers, _MOST_PIXELS // (width * height)) // views)
        parts = [self._count_part(poses[k : k + most]) for k in range(0, len(poses), most)]
        return np.concatenate(parts) if parts else np.empty((0, views, 2), np.int64)

    def _shown(self) -> moderngl.TextureArray:
        if self._masks is None:
            raise ValueError("no masks are set: call `show` first")
        return self._masks

    def _count_part(self, poses: Array) -> NDArray[np.int64]:
        width, height, views = self._shown().size
        # transposed, since OpenGL stores matrices column by column
        clip = np.einsum("cij,njk->ncki", self._to_clip, poses)
        layers = len(poses) * views
        matrices = self._gl.buffer(np.ascontiguousarray(clip, np.float32))
        counts = self._gl.buffer(np.zeros(2 * layers, np.uint32))
        try:
            self._draw(matrices, layers)
            self._shown().use(1)
            counts.bind_to_storage_buffer(1)
            self._compute["views"], self._compute["size"] = views, (width, height)
            self._compute.run(-(-width // _TILE_PX), -(-height // _TILE_PX), layers)
            self._gl.memory_barrier()
            return np.frombuffer(counts.read(), np.uint32).astype(np.int64).reshape(len(poses), views, 2)
        finally:
            matrices.release()
            counts.release()

    def _draw(self, matrices: moderngl.Buffer, layers: int) -> None:
        texture, frame = self._target(layers)
        self._gl.enable_only(self._flags)
        self._gl.front_face = "cw"  # flipped vertically: image row 0 is drawn to the bottom row of the render target
        frame.use()
        frame.clear()
        matrices.bind_to_storage_buffer(0)
        for shade, array in self._passes:
            self._program["shade"] = shade
            array.render(instances=layers)
        texture.use(0)

    def _target(self, layers: int) -> tuple[moderngl.TextureArray, moderngl.Framebuffer]:
        """Return a render target with at least `layers` layers; cache several sizes, since clearing takes time."""
        width, height, views = self._shown().size
        room = min(1 << (layers - 1).bit_length(), self._most_layers)
        if room not in self._targets:
            texture = self._gl.texture_array((width, height, room), 1, dtype="f1")
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self._targets[room] = texture, self._gl.framebuffer([texture])
        return self._targets[room]

    def _drop_textures(self) -> None:
        for texture, frame in self._targets.values():
            frame.release()
            texture.release()
        self._targets.clear()
        if self._masks is not None:
            self._masks.release()
            self._masks = None
