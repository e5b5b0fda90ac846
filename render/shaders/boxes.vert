// Relief boxes, instanced: a unit cube stretched over each cell.
layout(location = 0) in vec3 position;
layout(location = 1) in vec4 instance_rectangle;  // lowest X, lowest Y, width, height, mm
layout(location = 2) in float instance_alpha;
uniform mat4 M;
uniform mat4 V;
uniform mat4 P;
uniform float delta0;
uniform vec2 height_range;
out vec3 canvas_position;
flat out float box_alpha;
flat out vec3 box_low;
flat out vec3 box_high;

void main() {
    box_low = vec3(instance_rectangle.xy, delta0);
    box_high = vec3(instance_rectangle.xy + instance_rectangle.zw, height_range.y);
    box_alpha = instance_alpha;
    canvas_position = mix(box_low, box_high, position);
    gl_Position = P * V * M * vec4(canvas_position, 1.0);
}
