// Exact: the viewing ray walks the pyramid of triangles.glsl down to single cells, and hits the two
// triangles that the mesh has there. Back faces of the box are drawn, so the camera may be inside
// it. The ray starts in double precision: from far away single precision is micrometres.
in vec3 canvas_position;
uniform dvec3 eye;             // mm, canvas frame
uniform dvec3 ray_corner;      // viewing ray of the picture's lower left corner
uniform dvec3 ray_dx;          // and its change per pixel
uniform dvec3 ray_dy;
uniform dvec3 cells_low;
uniform dvec3 cells_high;
uniform dvec2 first_texel;     // X and Y of the centre of texel [0, 0], mm
uniform double pitch;          // mm, from texel to texel

void main() {
    dvec3 towards = normalize(ray_corner + gl_FragCoord.x * ray_dx + gl_FragCoord.y * ray_dy);
    // A component of zero must not divide: a ray along the box's side is in or out of it.
    dvec3 slope = dvec3(
        abs(towards.x) > 1e-15 ? towards.x : 1e-15,
        abs(towards.y) > 1e-15 ? towards.y : 1e-15,
        abs(towards.z) > 1e-15 ? towards.z : 1e-15
    );
    dvec3 one = (cells_low - eye) / slope, other = (cells_high - eye) / slope;
    dvec3 first = min(one, other), last = max(one, other);
    double entry = max(max(first.x, first.y), max(first.z, 0.0));
    double leave = min(min(last.x, last.y), last.z);
    if (entry > leave) MISS(0);
    dvec3 from = eye + entry * towards;
    dvec3 start = dvec3((from.x - first_texel.x) / pitch, (first_texel.y - from.y) / pitch, from.z);
    dvec3 along = towards * dvec3(1.0 / pitch, -1.0 / pitch, 1.0);
    int steps;
    ivec2 cell;
    real3 triangle;
    real hit = first_hit(
        Ray(start, real3(start), real3(along), real(leave - entry)), steps, cell, triangle
    );
    if (hit < 0.0) MISS(steps);
    dvec3 found = start + double(hit) * along;
#ifndef PRECISE
    // Along a triangle that is seen edge-on single precision is too little again.
    double clearance = found.z - triangle.x - dot(dvec2(triangle.yz), found.xy - dvec2(cell));
    double fall = along.z - dot(dvec2(triangle.yz), along.xy);
    if (fall < 0.0) found -= clamp(clearance / fall, -0.2, 0.2) * along;
#endif
    vec3 place = vec3(found);
    vec3 p = vec3(first_texel + dvec2(found.x, -found.y) * pitch, found.z);
    vec2 uv = (place.xy + 0.5) / vec2(pyramid_cells + 1);
    float level = level_of_detail(p);
    gl_FragDepth = depth_of(p);
    show(p, uv, textureLod(relief_map, uv, level), level, 1.0, steps);
}
