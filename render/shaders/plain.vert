// Plane, mesh, or the box around the whole surface: vertices in the canvas frame.
layout(location = 0) in vec3 position;
uniform mat4 M;
uniform mat4 V;
uniform mat4 P;
out vec3 canvas_position;
flat out float box_alpha;
flat out vec3 box_low;
flat out vec3 box_high;
uniform vec3 bounds_low;
uniform vec3 bounds_high;

void main() {
    canvas_position = position;
    box_alpha = 1.0;
    box_low = bounds_low;
    box_high = bounds_high;
    gl_Position = P * V * M * vec4(position, 1.0);
}
