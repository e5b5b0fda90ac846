// Relief mapping (paper section 5.2; Policarpo 2005): the viewing ray through a box is searched
// linearly, then by bisection. Back faces are drawn, so the camera may be inside the box.
in vec3 canvas_position;
flat in float box_alpha;
flat in vec3 box_low;
flat in vec3 box_high;
uniform int linear_steps;      // most steps of the linear search
uniform int binary_steps;
uniform float texel;           // mm
uniform bool solid_sides;      // whether a ray that enters under the surface hits it there

float clearance(vec3 p) { return p.z - texture(relief_map, texture_coordinate(p.xy)).x; }

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
    if (entry > leave) discard;

    vec3 from = eye + entry * ray;
    vec3 along = (leave - entry) * ray;
    // No more steps than half texels crossed, sideways or in height.
    float crossed = max(length(along.xy), abs(along.z) * 0.25) / (0.5 * texel);
    int steps = clamp(int(ceil(crossed)), 2, linear_steps);
    bool above = clearance(from) > 0.0;
    if (!above && solid_sides) {
        vec2 uv = texture_coordinate(from.xy);
        if (texture(relief_map, uv).w < 0.5) discard;
        gl_FragDepth = depth_of(from);
        frag_color = vec4(shade(from, uv), box_alpha);
        return;
    }
    float before = 0.0;
    float hit = -1.0;
    for (int i = 1; i <= steps; ++i) {
        float t = float(i) / float(steps);
        float c = clearance(from + t * along);
        if (above && c <= 0.0) { hit = t; break; }
        above = c > 0.0;
        before = t;
    }
    if (hit < 0.0) discard;
    for (int i = 0; i < binary_steps; ++i) {
        float middle = 0.5 * (before + hit);
        if (clearance(from + middle * along) > 0.0) before = middle; else hit = middle;
    }
    vec3 p = from + hit * along;
    vec2 uv = texture_coordinate(p.xy);
    if (texture(relief_map, uv).w < 0.5) discard;
    gl_FragDepth = depth_of(p);
    frag_color = vec4(shade(p, uv), box_alpha);
}
