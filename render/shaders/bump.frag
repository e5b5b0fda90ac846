// Negligible relief (paper section 5.1): a plane at δ0; directions from the true height (5.4).
in vec3 canvas_position;

void main() {
    vec2 uv = texture_coordinate(canvas_position.xy);
    float level = level_of_detail(canvas_position);
    vec4 relief = textureLod(relief_map, uv, level);
    if (relief.w < 0.5) MISS(0);
#if SHOWN == 1
    // What the eye is led to believe: the plane's point.
    frag_color = vec4(canvas_position, 1.0);
#else
    show(vec3(canvas_position.xy, relief.x), uv, relief, level, 1.0, 0);
#endif
}
