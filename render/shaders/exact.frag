// Exact: the viewing ray walks the pyramid of triangles.glsl down to single cells, and hits the two
// triangles that the mesh has there. Back faces of the box are drawn, so the camera may be inside
// it. PRECISE counts in double precision, as triangles.glsl says.
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
    real3 towards = normalize(
        real3(ray_corner) + gl_FragCoord.x * real3(ray_dx) + gl_FragCoord.y * real3(ray_dy)
    );
    // A component of zero must not divide: a ray along the box's side is in or out of it.
    real3 inverse = 1.0 / real3(
        abs(towards.x) > 1e-15 ? towards.x : 1e-15,
        abs(towards.y) > 1e-15 ? towards.y : 1e-15,
        abs(towards.z) > 1e-15 ? towards.z : 1e-15
    );
    real3 one = real3(cells_low - eye) * inverse, other = real3(cells_high - eye) * inverse;
    real3 first = min(one, other), last = max(one, other);
    real entry = max(max(first.x, first.y), max(first.z, 0.0));
    real leave = min(min(last.x, last.y), last.z);
    if (entry > leave) MISS(0);
    real3 to_texels = real3(1.0 / pitch, -1.0 / pitch, 1.0);
    real3 from = (real3(eye - dvec3(first_texel, 0.0)) + entry * towards) * to_texels;
    real3 along = towards * to_texels;
    int steps;
    ivec2 cell;
    real3 triangle;
    real hit = first_hit(Ray(from, along, leave - entry), steps, cell, triangle);
    if (hit < 0.0) MISS(steps);
    real3 found = from + hit * along;
    vec3 p = vec3(real3(first_texel, 0.0) + found / to_texels);
    vec2 uv = (vec2(found.xy) + 0.5) / vec2(pyramid_cells + 1);
    float level = level_of_detail(p);
    gl_FragDepth = depth_of(p);
    show(p, uv, textureLod(relief_map, uv, level), level, 1.0, steps);
}
