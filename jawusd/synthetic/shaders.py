"""GLSL programs of the renderer: scene, contact shadows, and resampling through the lens."""

# The alpha channel of the scene stores the label of the surface.
SCENE_VERTEX = """
#version 330
in vec3 in_position;
in vec3 in_normal;
in vec3 in_color;
in vec3 in_material;   // gloss, skin grain, inside the mouth
in vec3 in_rest;
uniform mat4 clip_from_world;
uniform mat4 world_from_part;
out vec3 world;
out vec3 normal;
out vec3 color;
out vec3 material;
out vec3 rest;
void main() {
    vec4 p = world_from_part * vec4(in_position, 1.0);
    gl_Position = clip_from_world * p;
    world = p.xyz;
    normal = mat3(world_from_part) * in_normal;
    color = in_color;
    material = in_material;
    rest = in_rest;
}
"""

SCENE_FRAGMENT = """
#version 330
in vec3 world;
in vec3 normal;
in vec3 color;
in vec3 material;
in vec3 rest;
uniform vec3 eye;
uniform mat4 head_from_world;
uniform float label;
uniform float light;
uniform float freckles;
uniform sampler3D grain;   // smooth noise and its gradient, each 0..1
layout(location = 0) out vec4 out_color;

vec3 lit(vec3 n, vec3 view, vec3 albedo, vec3 direction, vec3 power, float gloss, float wrap) {
    float facing = dot(n, direction);
    float diffuse = max((facing + wrap) / (1.0 + wrap), 0.0);
    vec3 halfway = normalize(direction + view);
    float highlight = pow(max(dot(n, halfway), 0.0), mix(18.0, 90.0, gloss)) * step(0.0, facing);
    return power * (albedo * diffuse + gloss * highlight);
}
void main() {
    vec3 n = normalize(normal);
    vec3 view = normalize(eye - world);
    vec3 albedo = color;
    float gloss = material.x;
    if (material.y > 0.0) {   // skin: mottled colour, pores and fine lines
        float blotch = texture(grain, rest * 0.0034).r + 0.7 * texture(grain, rest * 0.011 + 0.3).r - 0.85;
        vec4 fine = texture(grain, rest * 0.045) - 0.5;
        vec4 pore = texture(grain, rest * 0.10 + 0.6) - 0.5;
        albedo *= 1.0 + material.y * (vec3(0.10, 0.20, 0.22) * blotch + 0.10 * fine.r + 0.08 * pore.r);
        n = normalize(n - material.y * (0.16 * fine.gba + 0.14 * pore.gba));
        // spots of about 2 mm on a tenth of the skin, none on the red of the lips
        float spot = smoothstep(0.67, 0.75, texture(grain, rest * 0.028 + 0.17).r);
        albedo *= 1.0 - freckles * spot * step(0.95, material.y);
    }
    float depth = (head_from_world * vec4(world, 1.0)).z;
    float open_air = mix(1.0, mix(0.10, 1.0, smoothstep(-66.0, 0.0, depth)), material.z);
    float wrap = 0.25 * (1.0 - material.z);
    vec3 key = normalize(vec3(-0.55, -0.75, -1.0));
    vec3 fill = normalize(vec3(0.75, -0.20, -1.0));
    vec3 low = normalize(vec3(0.1, 0.7, -1.0));
    vec3 total = albedo * vec3(0.16, 0.165, 0.18);
    total += lit(n, view, albedo, key, vec3(0.72, 0.69, 0.65), gloss, wrap);
    total += lit(n, view, albedo, fill, vec3(0.36, 0.37, 0.40), gloss, wrap);
    total += lit(n, view, albedo, low, vec3(0.13, 0.12, 0.12), 0.3 * gloss, wrap);
    out_color = vec4(total * open_air * light, label);
}
"""

SCREEN_VERTEX = """
#version 330
in vec2 in_corner;
out vec2 at;
void main() { at = 0.5 * in_corner + 0.5; gl_Position = vec4(in_corner, 0.0, 1.0); }
"""

# Contact shadows: fraction of the neighbourhood of a point that lies in front of it.
SHADOW_FRAGMENT = """
#version 330
in vec2 at;
uniform sampler2D depth;
uniform vec2 planes_mm;          // near, far
uniform vec2 texel;
uniform float focal_px;
out vec4 out_shadow;
float range_mm(vec2 p) {
    float d = texture(depth, p).r * 2.0 - 1.0;
    return 2.0 * planes_mm.x * planes_mm.y / (planes_mm.y + planes_mm.x - d * (planes_mm.y - planes_mm.x));
}
void main() {
    float here = range_mm(at);
    float turn = 6.2831853 * fract(52.9829189 * fract(dot(floor(gl_FragCoord.xy), vec2(0.06711056, 0.00583715))));
    float hidden = 0.0;
    for (int i = 0; i < 14; ++i) {
        float r = (float(i) + 0.7) / 14.0;
        float a = turn + float(i) * 2.39996;
        vec2 offset = vec2(cos(a), sin(a)) * (r * 4.5 * focal_px / here);
        float front = here - range_mm(at + offset * texel);
        float reach = 4.5 * r;
        hidden += smoothstep(0.25 * reach, 1.3 * reach + 0.3, front) * (1.0 - smoothstep(9.0, 16.0, front));
    }
    out_shadow = vec4(1.0 - 0.80 * hidden / 14.0);
}
"""

# Resampling of the undistorted scene to the recorded image: colour, and coverage by upper and lower teeth.
LENS_FRAGMENT = """
#version 330
in vec2 at;
uniform sampler2D scene;
uniform sampler2D shadow;
uniform sampler2D bend_px;        // pinhole minus recorded pixel
uniform sampler2D jitter_upper_px;
uniform sampler2D jitter_lower_px;
uniform vec2 size_px;
uniform vec2 to_scene;            // scene pixel = x * pixel + y
uniform vec2 scene_size_px;
uniform vec3 backdrop;
layout(location = 0) out vec4 out_color;
layout(location = 1) out vec4 out_masks;
vec4 fetch(vec2 pixel) { return texelFetch(scene, ivec2(clamp(pixel + 0.5, vec2(0.0), scene_size_px - 1.0)), 0); }
void main() {
    vec2 pixel = at * size_px - 0.5;
    vec2 ideal = pixel + texture(bend_px, at).rg;
    vec3 total = vec3(0.0);
    vec2 covered = vec2(0.0);
    vec2 shift_upper = texture(jitter_upper_px, at).rg;
    vec2 shift_lower = texture(jitter_lower_px, at).rg;
    // one scene pixel lies on the ray, its neighbours half a picture pixel away: weights 1 2 1 in both directions
    for (int j = -1; j <= 1; ++j) for (int i = -1; i <= 1; ++i) {
        float weight = float((2 - abs(i)) * (2 - abs(j))) / 16.0;
        vec2 tap = ideal + 0.5 * vec2(i, j);
        vec2 on_scene = to_scene.x * tap + to_scene.y;
        vec4 s = fetch(on_scene);
        total += weight * (s.a > 8.0 ? backdrop : s.rgb * texture(shadow, (on_scene + 0.5) / scene_size_px).r);
        covered.x += weight * step(abs(fetch(on_scene + to_scene.x * shift_upper).a - 1.0), 0.5);
        covered.y += weight * step(abs(fetch(on_scene + to_scene.x * shift_lower).a - 2.0), 0.5);
    }
    // a soft shoulder keeps highlights on wet surfaces from clipping
    total = total / (1.0 + 0.35 * max(total - 0.55, 0.0));
    out_color = vec4(pow(clamp(total, 0.0, 1.0), vec3(1.0 / 2.2)), 1.0);
    out_masks = vec4(covered, 0.0, 1.0);
}
"""
