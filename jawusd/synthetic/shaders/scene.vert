#version 330
// The alpha channel of the scene stores the label of the surface.
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
