// Mesh: the triangles are the surface.
in vec3 canvas_position;

void main() {
    vec2 uv = texture_coordinate(canvas_position.xy);
    float level = level_of_detail(canvas_position);
    show(canvas_position, uv, textureLod(relief_map, uv, level), level, 1.0, 0);
}
