// Bounded: no more search than the parallax that a fragment could show needs. A height that is off
// by 1 mm is seen off by `parallax` pixels: sin θ / (d · pixel_angle), θ between ray and normal, d
// the distance. The fragment is drawn on a plane; the place of its ray is its height z alone.
//
// PLANE   no height is off by more than the budget: nothing is searched.
// FRONT   nothing hides anything: from the plane to the height found there, until it is near enough.
// GRAZING from the top down by cones that hold no surface (J. Dummer, Cone step mapping, 2006).
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
const float GAP = -1e30;
// Steps longer than is safe, where a step that goes too deep is seen by less than a pixel and the
// next comes up again; and how near is near enough, in budgets.
#ifdef TRIANGLES
const float RELAXED = 1.2;
const float NEAR_ENOUGH = 0.5;
#else
const float RELAXED = 2.2;
const float NEAR_ENOUGH = 0.8;
#endif

#ifdef TRIANGLES
// To where the ray meets the triangle below z; unchanged where there is none.
float onto_triangle(float z, vec2 plane_xy, vec2 drift) {
    vec2 place = texture_coordinate(plane_xy + z * drift) * vec2(cells + 1) - 0.5;
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

void main() {
    vec3 to_plane = canvas_position - to_canvas(cam_pos);
    vec2 drift = to_plane.xy / to_plane.z;  // of the ray per mm of height
    float d2 = dot(to_plane, to_plane);
    float parallax = length(to_plane.xy) / (d2 * pixel_angle);
    float level = level_of_detail(canvas_position);
    vec2 plane_xy = canvas_position.xy - canvas_position.z * drift;
    float z = canvas_position.z;
    int steps = 0;
#ifdef PLANE
    vec2 uv = texture_coordinate(canvas_position.xy);
    vec4 relief = textureLod(relief_map, uv, level);
#else
#ifdef FRONT
    float tolerance = 0.3 * budget / parallax;
    vec2 uv;
    vec4 relief;
    for (; steps < most_steps; ++steps) {
        uv = texture_coordinate(plane_xy + z * drift);
        relief = textureLod(relief_map, uv, level);
        if (abs(z - relief.x) <= tolerance) break;
        z = relief.x;
    }
    z = relief.x;
#else
    float tolerance = NEAR_ENOUGH * budget / parallax;
    float reach = length(drift);
    z = top - search_origin;
    vec2 origin_xy = plane_xy + search_origin * drift;
    for (; steps < most_steps; ++steps) {
        vec2 found = textureLod(search_map, texture_coordinate(origin_xy + z * drift), 0.0).xy;
        float clearance = z - found.x;
        if (abs(clearance) <= tolerance) { z = found.x; break; }
        z -= clearance * min(RELAXED / (1.0 + found.y * reach), 1.0);
    }
    z += search_origin;
#endif
#ifdef TRIANGLES
    z = onto_triangle(z, plane_xy, drift);
    z = onto_triangle(z, plane_xy, drift);
#endif
    float share = clamp(plane_error * parallax / budget - 1.0, 0.0, 1.0);
    z = mix(canvas_position.z, z, share);
#ifndef FRONT
    vec2 uv = texture_coordinate(plane_xy + z * drift);
    vec4 relief = textureLod(relief_map, uv, level);
#else
    uv = texture_coordinate(plane_xy + z * drift);
#ifdef TRIANGLES
    relief = textureLod(relief_map, uv, level);
#endif
#endif
#endif
    if (relief.w < 0.5) MISS(steps);
    vec3 p = vec3(plane_xy + z * drift, z);
#ifndef PLANE
    // The surface ends at the outermost texel centres.
    vec2 beyond = abs(uv - 0.5) * vec2(cells + 1) - 0.5 * vec2(cells);
    if (max(beyond.x, beyond.y) > 0.0) MISS(steps);
    gl_FragDepth = depth_of(p);
#endif
    show(p, uv, relief, level, 1.0, steps);
}
