#version 330
// Contact shadows: fraction of the neighbourhood of a point that lies in front of it.
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
