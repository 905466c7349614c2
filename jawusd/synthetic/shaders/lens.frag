#version 330
// Resampling of the undistorted scene to the recorded image: colour, and coverage by upper and lower teeth.
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
