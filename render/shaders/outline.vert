// What a painting casts on others: its outline, at its lowest height, so never on itself.
uniform mat4 M;
uniform mat4 V;
uniform mat4 P;
uniform vec2 grid_corner;
uniform vec2 grid_size;
uniform vec2 height_range;
out vec2 place;

void main() {
    place = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    vec2 xy = grid_corner + place * grid_size * vec2(1.0, -1.0);
    gl_Position = P * V * M * vec4(xy, height_range.x, 1.0);
}
