// The plane of the bounded mode: a unit square stretched over where the surface is seen on it.
layout(location = 0) in vec3 position;
uniform mat4 M;
uniform mat4 V;
uniform mat4 P;
uniform vec4 plane_rectangle;  // lowest X and Y, highest X and Y, mm
uniform float plane_height;
out vec3 canvas_position;

void main() {
    vec2 xy = mix(plane_rectangle.xy, plane_rectangle.zw, position.xy);
    canvas_position = vec3(xy, plane_height);
    gl_Position = P * V * M * vec4(canvas_position, 1.0);
}
