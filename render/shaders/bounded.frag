// Bounded: no more search than the parallax that a fragment could show needs. A height that is off
// by 1 mm is seen off by `parallax` pixels: sin θ / (d · pixel_angle), θ between ray and normal, d
// the distance. The fragment is drawn on a plane; the place of its ray is its height z alone.
//
// PLANE   no height is off by more than the budget: nothing is searched.
// FRONT   nothing hides anything: from the plane to the height found there, until it is near enough.
// GRAZING from the top down by cones that hold no surface (J. Dummer, Cone step mapping, 2006).
// BETWEEN both of these, mixed.
// TRIANGLES ends on the triangles of the mesh, where texels are larger than pixels.
in vec3 canvas_position;
uniform sampler2D search_map;    // height over search_origin, and slope of a cone without surface
uniform float search_origin;     // mm
uniform sampler2D height_map;    // mm; GAP where nothing was measured
uniform ivec2 cells;
uniform float top;               // mm, greatest height
uniform float plane_error;       // mm, by which a height may differ from the plane's
uniform float budget;            // pixels
uniform int most_steps;
uniform float relaxed;           // steps of the cones that are longer than is safe
uniform float near_enough;       // for the cones, in budgets
uniform float grazing_share;     // of the cones, BETWEEN
uniform float triangle_share;
const float GAP = -1e30;

// Texture coordinates along the ray, by height.
struct Track { vec2 start; vec2 drift; };
vec2 uv_at(Track track, float z) { return track.start + z * track.drift; }

#ifdef TRIANGLES
// To where the ray meets the triangle below z; unchanged where there is none.
float onto_triangle(float z, Track track, vec2 drift) {
    vec2 place = uv_at(track, z) * vec2(cells + 1) - 0.5;
    vec2 cell = clamp(floor(place), vec2(0.0), vec2(cells - 1));
    vec4 corners = textureGather(height_map, (cell + 1.0) / vec2(cells + 1));
    if (min(min(corners.x, corners.y), min(corners.z, corners.w)) < 0.5 * GAP) return z;
    float a = corners.w, b = corners.z, c = corners.x, d = corners.y;
    vec2 g = place - cell;
    vec3 h = g.x + g.y < 1.0 ? vec3(a, b - a, c - a) : vec3(b + c - d, d - c, d - b);
    float clearance = z - h.x - dot(h.yz, g);
    float fall = 1.0 - dot(h.yz, drift * vec2(1.0, -1.0)) / texel;
    // Not beyond the neighbouring cells, where other triangles are.
    float most = texel / max(length(drift), 1e-6);
    return fall > 0.0 ? z - clamp(clearance / fall, -most, most) : z;
}
#endif

#if defined(FRONT) || defined(BETWEEN)
// Where what the ray passes over is as high as the ray, or nearly.
float found_from_plane(
    Track track, float z, float tolerance, float level, out vec4 relief, out int steps
) {
    for (steps = 0; steps < most_steps; ++steps) {
        relief = textureLod(relief_map, uv_at(track, z), level);
        if (abs(z - relief.x) <= tolerance) break;
        z = relief.x;
    }
    return relief.x;
}
#endif

#if defined(GRAZING) || defined(BETWEEN)
// A step that goes too deep is seen by less than a pixel, and the next comes up again.
float found_by_cones(Track track, float reach, float tolerance, out int steps) {
    float z = top - search_origin;
    track.start = uv_at(track, search_origin);
    for (steps = 0; steps < most_steps; ++steps) {
        vec2 found = textureLod(search_map, uv_at(track, z), 0.0).xy;
        float clearance = z - found.x;
        if (abs(clearance) <= tolerance) { z = found.x; break; }
        z -= clearance * min(relaxed / (1.0 + found.y * reach), 1.0);
    }
    return z + search_origin;
}
#endif

#ifdef PLANE
void main() {
    vec2 uv = texture_coordinate(canvas_position.xy);
    float level = level_of_detail(canvas_position);
    vec4 relief = textureLod(relief_map, uv, level);
    if (relief.w < 0.5) MISS(0);
    show(canvas_position, uv, relief, level, 1.0, 0);
}
#else
void main() {
    vec3 to_plane = canvas_position - to_canvas(cam_pos);
    vec2 drift = to_plane.xy / to_plane.z;  // of the ray per mm of height
    float d2 = dot(to_plane, to_plane);
    float parallax = length(to_plane.xy) / (d2 * pixel_angle);
    float level = level_of_detail(canvas_position);
    vec2 plane_xy = canvas_position.xy - canvas_position.z * drift;
    Track track = Track(texture_coordinate(plane_xy), drift * vec2(1.0, -1.0) / grid_size);
    float z = canvas_position.z;
    // From where the plane hides its error to where it is off by two budgets.
    float share = clamp(plane_error * parallax / budget - 1.0, 0.0, 1.0);
    int steps = 0;
    vec4 relief;
#if defined(FRONT) || defined(BETWEEN)
    // Where nothing is to be searched yet, the plane itself is near enough.
    float tolerance = mix(1.0, 0.3, share) * budget / parallax;
    z = found_from_plane(track, z, tolerance, level, relief, steps);
#endif
#if defined(GRAZING) || defined(BETWEEN)
    int more;
    float lower = found_by_cones(track, length(drift), near_enough * budget / parallax, more);
    steps += more;
#ifdef BETWEEN
    z = mix(z, lower, grazing_share);
#else
    z = lower;
#endif
#endif
#ifdef TRIANGLES
    float on_triangle = onto_triangle(z, track, drift);
    z = mix(z, onto_triangle(on_triangle, track, drift), triangle_share);
#endif
    z = mix(canvas_position.z, z, share);
    vec2 uv = uv_at(track, z);
    // What was found from the plane is near enough to be shown; where it gives way, so does this.
#if defined(BETWEEN)
    relief = mix(relief, textureLod(relief_map, uv, level), max(grazing_share, triangle_share));
#elif !defined(FRONT)
    relief = textureLod(relief_map, uv, level);
#elif defined(TRIANGLES)
    relief = mix(relief, textureLod(relief_map, uv, level), triangle_share);
#endif
    if (relief.w < 0.5) MISS(steps);
    vec3 p = vec3(plane_xy + z * drift, z);
    // The surface ends at the outermost texel centres.
    vec2 beyond = abs(uv - 0.5) * vec2(cells + 1) - 0.5 * vec2(cells);
    if (max(beyond.x, beyond.y) > 0.0) MISS(steps);
    gl_FragDepth = depth_of(p);
    show(p, uv, relief, level, 1.0, steps);
}
#endif
