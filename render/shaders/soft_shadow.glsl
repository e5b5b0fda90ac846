// How much of a spot lamp, a small disc, is seen from a place: by its shadow map, as far as the map's
// nearest surfaces tell (R. Fernando, Percentage-closer soft shadows, 2005). Samples lie on the
// plane that the place is on, so that its own slant casts no shadow.
uniform float lamp_radius_mm;
const int SHADOW_SAMPLES = 12;

// Distance from the lamp along its axis, of a depth in the map: as clip.w for the same clip.z.
float lamp_distance(mat4 light_matrix, vec4 clip, float depth) {
    float scale = length(vec3(light_matrix[0].z, light_matrix[1].z, light_matrix[2].z));
    return (clip.z - scale * clip.w) / (2.0 * depth - 1.0 - scale);
}

// Points of a disc by the golden angle (H. Vogel, 1979), turned from pixel to pixel.
vec2 disc_sample(int i, float turn) {
    float angle = 2.39996323 * float(i) + turn;
    return sqrt((float(i) + 0.5) / float(SHADOW_SAMPLES)) * vec2(cos(angle), sin(angle));
}

float soft_light(mat4 light_matrix, sampler2D shadow_map, vec3 place, vec3 normal) {
    vec4 clip = light_matrix * vec4(place, 1.0);
    if (clip.w <= 0.0) return 1.0;
    // A texel of the map at the place, mm.
    float scale = length(vec3(light_matrix[0].x, light_matrix[1].x, light_matrix[2].x));
    float texel_mm = 2.0 * clip.w / (scale * float(textureSize(shadow_map, 0).x));
    vec3 t = normalize(abs(normal.x) < 0.9 ? cross(normal, vec3(1, 0, 0)) : cross(normal, vec3(0, 1, 0)));
    vec4 start = light_matrix * vec4(place + 2.0 * texel_mm * normal, 1.0);
    vec4 across = light_matrix * vec4(t, 0.0), along = light_matrix * vec4(cross(normal, t), 0.0);
    float turn = 6.2831853 * fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715))));
    float radius = lamp_radius_mm, blockers = 0.0, distances = 0.0, hidden = 0.0;
    // First how far away what hides the lamp is, and with it how wide the half shadow; then how much
    // of the lamp is hidden.
    for (int pass = 0; pass < 2; ++pass) {
        hidden = 0.0;
        for (int i = 0; i < SHADOW_SAMPLES; ++i) {
            vec2 at = radius * disc_sample(i, turn);
            vec4 q = start + at.x * across + at.y * along;
            vec3 found = 0.5 * q.xyz / q.w + 0.5;
            if (any(lessThan(found, vec3(0.0))) || any(greaterThan(found, vec3(1.0)))) continue;
            float depth = textureLod(shadow_map, found.xy, 0.0).r;
            if (depth >= found.z) continue;
            hidden += 1.0;
            if (pass == 0) {
                blockers += 1.0;
                distances += lamp_distance(light_matrix, q, depth);
            }
        }
        if (blockers == 0.0) return 1.0;
        float nearest = distances / blockers;
        radius = max(lamp_radius_mm * (clip.w - nearest) / nearest, 1.5 * texel_mm);
    }
    return 1.0 - hidden / float(SHADOW_SAMPLES);
}
