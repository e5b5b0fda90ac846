// Mesh: the triangles are the surface.
in vec3 canvas_position;

void main() {
    frag_color = vec4(shade(canvas_position, texture_coordinate(canvas_position.xy)), 1.0);
}
