// Negligible relief (paper section 5.1): a plane at δ0; directions from the true height (5.4).
in vec3 canvas_position;

void main() {
    vec2 uv = texture_coordinate(canvas_position.xy);
    vec4 relief = texture(relief_map, uv);
    if (relief.w < 0.5) discard;
    frag_color = vec4(shade(vec3(canvas_position.xy, relief.x), uv), 1.0);
}
