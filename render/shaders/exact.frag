// Exact: the viewing ray walks a pyramid of least and greatest heights (Tevs, Ihrke, Seidel, I3D
// 2008) down to single cells, and hits the two triangles that the mesh has there. Back faces of the
// box are drawn, so the camera may be inside it. The ray starts in double precision: from far away
// single precision is micrometres.
in vec3 canvas_position;
uniform dvec3 eye;             // mm, canvas frame
uniform dvec3 ray_corner;      // viewing ray of the picture's lower left corner
uniform dvec3 ray_dx;          // and its change per pixel
uniform dvec3 ray_dy;
uniform dvec3 cells_low;
uniform dvec3 cells_high;
uniform dvec2 first_texel;     // X and Y of the centre of texel [0, 0], mm
uniform sampler2D height_map;  // mm; GAP where nothing was measured
uniform sampler2D pyramid;     // least and greatest height of squares of cells; GAP as least if any
uniform ivec2 cells;
uniform int pyramid_top;
const float GAP = -1e30;

// Places of a ray: texels to the right, texels down, mm towards the viewer.
struct Ray { dvec3 start; vec3 from; vec3 along; float length; };

// First crossing from above within the two triangles of a cell, between two places of the ray;
// below zero where there is none. `above` tells whether the ray came to the cell above its surface.
// The triangle is its height at the cell's first corner, and slopes.
float hit_in_cell(
    Ray ray, ivec2 cell, float enter, float leave, inout bool above, out vec3 triangle
) {
    vec4 corners = textureGather(height_map, (vec2(cell) + 1.0) / vec2(cells + 1));
    float a = corners.w, b = corners.z, c = corners.x, d = corners.y;
    bvec4 missing = lessThan(vec4(a, b, c, d), vec4(0.5 * GAP));
    // The diagonal runs from b to c unless one of those is missing.
    bool falling = !(missing.y || missing.z);
    vec2 start = vec2(ray.start.xy - dvec2(cell));
    float turn = falling ? ray.along.x + ray.along.y : ray.along.x - ray.along.y;
    float side = falling ? start.x + start.y - 1.0 : start.x - start.y;
    float split = turn != 0.0 ? -side / turn : leave;
    bool splits = split > enter && split < leave;
    for (int part = 0; part < 2; ++part) {
        if (part == 1 && !splits) break;
        float t0 = part == 0 ? enter : split;
        float t1 = part == 0 && splits ? split : leave;
        vec2 middle = start + 0.5 * (t0 + t1) * ray.along.xy;
        vec3 h;
        bool there;
        if (falling && middle.x + middle.y < 1.0) {
            h = vec3(a, b - a, c - a);
            there = !missing.x;
        } else if (falling) {
            h = vec3(b + c - d, d - c, d - b);
            there = !missing.w;
        } else if (middle.x > middle.y) {
            h = vec3(a, b - a, d - b);
            there = !(missing.x || missing.y || missing.w);
        } else {
            h = vec3(a, d - c, c - a);
            there = !(missing.x || missing.z || missing.w);
        }
        if (!there) { above = false; continue; }
        vec2 g0 = start + t0 * ray.along.xy, g1 = start + t1 * ray.along.xy;
        float c0 = ray.from.z + t0 * ray.along.z - (h.x + dot(h.yz, g0));
        float c1 = ray.from.z + t1 * ray.along.z - (h.x + dot(h.yz, g1));
        if ((above || c0 >= 0.0) && c1 < 0.0) {
            triangle = h;
            return t0 + (t1 - t0) * clamp(c0 / (c0 - c1), 0.0, 1.0);
        }
        above = c1 >= 0.0;
    }
    return -1.0;
}

// Place of the first hit along the ray; below zero where there is none.
float first_hit(Ray ray, out int steps, out ivec2 cell, out vec3 triangle) {
    cell = clamp(ivec2(floor(ray.from.xy)), ivec2(0), cells - 1);
    ivec2 forward = ivec2(greaterThan(ray.along.xy, vec2(0.0)));
    bvec2 moves = notEqual(ray.along.xy, vec2(0.0));
    float t = 0.0;
    bool above = false;
    int level = pyramid_top;
    for (steps = 0; steps < 16384; ++steps) {
        ivec2 low = (cell >> level) << level;
        ivec2 high = min(low + (1 << level), cells);
        vec2 border = vec2(mix(low, high, equal(forward, ivec2(1)))) - ray.from.xy;
        vec2 reached = vec2(
            moves.x ? border.x / ray.along.x : 1e30, moves.y ? border.y / ray.along.y : 1e30
        );
        float leave = clamp(min(reached.x, reached.y), t, ray.length);
        vec2 heights = texelFetch(pyramid, cell >> level, level).xy;
        float z0 = ray.from.z + t * ray.along.z, z1 = ray.from.z + leave * ray.along.z;
        if (min(z0, z1) > heights.y) {
            above = heights.x > 0.5 * GAP;
        } else if (max(z0, z1) < heights.x) {
            above = false;
        } else if (level > 0) {
            --level;
            continue;
        } else {
            float hit = hit_in_cell(ray, cell, t, leave, above, triangle);
            if (hit >= 0.0) return hit;
        }
        if (leave >= ray.length) break;
        t = leave;
        ivec2 here = clamp(ivec2(floor(ray.from.xy + t * ray.along.xy)), low, high - 1);
        ivec2 before = cell;
        cell = reached.x <= reached.y
            ? ivec2(forward.x == 1 ? high.x : low.x - 1, here.y)
            : ivec2(here.x, forward.y == 1 ? high.y : low.y - 1);
        if (any(lessThan(cell, ivec2(0))) || any(greaterThanEqual(cell, cells))) break;
        // Up again only where a larger square was left.
        if (level < pyramid_top && (before >> (level + 1)) != (cell >> (level + 1))) ++level;
    }
    return -1.0;
}

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
    dvec3 start = dvec3((from.x - first_texel.x) / texel, (first_texel.y - from.y) / texel, from.z);
    dvec3 along = towards * dvec3(1.0 / texel, -1.0 / texel, 1.0);
    int steps;
    ivec2 cell;
    vec3 triangle;
    float hit = first_hit(
        Ray(start, vec3(start), vec3(along), float(leave - entry)), steps, cell, triangle
    );
    if (hit < 0.0) MISS(steps);
    // Along a triangle that is seen edge-on single precision is too little again.
    dvec3 found = start + double(hit) * along;
    double clearance = found.z - triangle.x - dot(dvec2(triangle.yz), found.xy - dvec2(cell));
    double fall = along.z - dot(dvec2(triangle.yz), along.xy);
    if (fall < 0.0) found -= clamp(clearance / fall, -0.2, 0.2) * along;
    vec3 place = vec3(found);
    vec3 p = vec3(dvec2(first_texel) + dvec2(place.x, -place.y) * texel, place.z);
    vec2 uv = (place.xy + 0.5) / vec2(cells + 1);
    float level = level_of_detail(p);
    gl_FragDepth = depth_of(p);
    show(p, uv, textureLod(relief_map, uv, level), level, 1.0, steps);
}
