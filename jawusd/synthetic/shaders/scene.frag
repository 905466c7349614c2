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
