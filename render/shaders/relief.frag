// Relief mapping (paper section 5.2; Policarpo 2005): the viewing ray through a box is searched
// linearly, then by bisection. Back faces are drawn, so the camera may be inside the box.
in vec3 canvas_position;
flat in float box_alpha;
flat in vec3 box_low;
flat in vec3 box_high;
uniform int linear_steps;      // most steps of the linear search
uniform int binary_steps;
uniform bool solid_sides;      // whether a ray that enters under the surface hits it there

float clearance(vec3 p) { return p.z - textureLod(relief_map, texture_coordinate(p.xy), 0.0).x; }

void show_hit(vec3 p, int steps) {
    vec2 uv = texture_coordinate(p.xy);
    float level = level_of_detail(p);
    vec4 relief = textureLod(relief_map, uv, level);
    if (relief.w < 0.5) MISS(steps);
    gl_FragDepth = depth_of(p);
    show(p, uv, relief, level, box_alpha, steps);
}

void main() {
    vec3 eye = to_canvas(cam_pos);
    vec3 ray = canvas_position - eye;
    // Slabs; a component of zero gives infinities of the right sign.
    vec3 t_low = (box_low - eye) / ray;
    vec3 t_high = (box_high - eye) / ray;
    vec3 t_first = min(t_low, t_high);
    float entry = max(max(t_first.x, t_first.y), max(t_first.z, 0.0));
    vec3 t_last = max(t_low, t_high);
    float leave = min(min(t_last.x, t_last.y), t_last.z);
    if (entry > leave) MISS(0);

    vec3 from = eye + entry * ray;
    vec3 along = (leave - entry) * ray;
    // No more steps than half texels crossed, sideways or in height.
    float crossed = max(length(along.xy), abs(along.z) * 0.25) / (0.5 * texel);
    int steps = clamp(int(ceil(crossed)), 2, linear_steps);
    bool above = clearance(from) > 0.0;
    if (!above && solid_sides) {
        show_hit(from, 1);
        return;
    }
    float before = 0.0;
    float hit = -1.0;
    int i = 1;
    for (; i <= steps; ++i) {
        float t = float(i) / float(steps);
        float c = clearance(from + t * along);
        if (above && c <= 0.0) { hit = t; break; }
        above = c > 0.0;
        before = t;
    }
    if (hit < 0.0) MISS(i);
    for (int j = 0; j < binary_steps; ++j) {
        float middle = 0.5 * (before + hit);
        if (clearance(from + middle * along) > 0.0) before = middle; else hit = middle;
    }
    show_hit(from + hit * along, i + binary_steps);
}
