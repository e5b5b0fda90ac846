// Search of a ray for the triangles between texels, through a pyramid of least and greatest heights
// (Tevs, Ihrke, Seidel, I3D 2008).
//
// PRECISE counts in double precision: along a silhouette single precision takes the wrong side of it
// now and then, and shows what lies behind.
#ifdef PRECISE
#define real double
#define real2 dvec2
#define real3 dvec3
#define real4 dvec4
#else
#define real float
#define real2 vec2
#define real3 vec3
#define real4 vec4
#endif
uniform sampler2D pyramid_heights;  // mm; UNMEASURED where nothing was measured
uniform sampler2D pyramid;  // least and greatest height of squares of cells; UNMEASURED if any is
uniform ivec2 pyramid_cells;
uniform int pyramid_top;
const float UNMEASURED = -1e30;

// Heights at the corners of a cell: top left, top right, bottom left, bottom right.
vec4 corners_of(ivec2 cell) {
    return textureGather(pyramid_heights, (vec2(cell) + 1.0) / vec2(pyramid_cells + 1)).wzxy;
}

// The diagonal runs from top right to bottom left unless one of those is missing.
bool diagonal_falls(bvec4 missing) { return !(missing.y || missing.z); }

// The triangle at a place in a cell, as its height at the cell's first corner, and slopes.
bool triangle_at(real4 corners, bvec4 missing, real2 place, out real3 triangle) {
    real a = corners.x, b = corners.y, c = corners.z, d = corners.w;
    if (diagonal_falls(missing)) {
        if (place.x + place.y < 1.0) {
            triangle = real3(a, b - a, c - a);
            return !missing.x;
        }
        triangle = real3(b + c - d, d - c, d - b);
        return !missing.w;
    }
    if (place.x > place.y) {
        triangle = real3(a, b - a, d - b);
        return !(missing.x || missing.y || missing.w);
    }
    triangle = real3(a, d - c, c - a);
    return !(missing.x || missing.z || missing.w);
}

// Places of a ray: texels to the right, texels down, mm towards the viewer.
struct Ray { dvec3 start; real3 from; real3 along; real length; };

// First crossing from above within the two triangles of a cell, between two places of the ray;
// below zero where there is none. `above` tells whether the ray came to the cell above its surface.
// The triangle is its height at the cell's first corner, and slopes.
real hit_in_cell(
    Ray ray, ivec2 cell, real enter, real leave, inout bool above, out real3 triangle
) {
    vec4 heights = corners_of(cell);
    bvec4 missing = lessThan(heights, vec4(0.5 * UNMEASURED));
    real4 corners = real4(heights);
    bool falling = diagonal_falls(missing);
    real2 start = real2(ray.start.xy - dvec2(cell));
    real turn = falling ? ray.along.x + ray.along.y : ray.along.x - ray.along.y;
    real side = falling ? start.x + start.y - 1.0 : start.x - start.y;
    real split = turn != 0.0 ? -side / turn : leave;
    bool splits = split > enter && split < leave;
    for (int part = 0; part < 2; ++part) {
        if (part == 1 && !splits) break;
        real t0 = part == 0 ? enter : split;
        real t1 = part == 0 && splits ? split : leave;
        real2 middle = start + 0.5 * (t0 + t1) * ray.along.xy;
        real3 h;
        bool there = triangle_at(corners, missing, middle, h);
        if (!there) { above = false; continue; }
        real2 g0 = start + t0 * ray.along.xy, g1 = start + t1 * ray.along.xy;
        real c0 = ray.from.z + t0 * ray.along.z - (h.x + dot(h.yz, g0));
        real c1 = ray.from.z + t1 * ray.along.z - (h.x + dot(h.yz, g1));
        if ((above || c0 >= 0.0) && c1 < 0.0) {
            triangle = h;
            return t0 + (t1 - t0) * clamp(c0 / (c0 - c1), 0.0, 1.0);
        }
        above = c1 >= 0.0;
    }
    return real(-1.0);
}

// Place of the first hit along the ray; below zero where there is none.
real first_hit(Ray ray, out int steps, out ivec2 cell, out real3 triangle) {
    cell = clamp(ivec2(floor(ray.from.xy)), ivec2(0), pyramid_cells - 1);
    ivec2 forward = ivec2(greaterThan(ray.along.xy, real2(0.0)));
    bvec2 moves = notEqual(ray.along.xy, real2(0.0));
    real t = 0.0;
    bool above = false;
    int level = pyramid_top;
    for (steps = 0; steps < 16384; ++steps) {
        ivec2 low = (cell >> level) << level;
        ivec2 high = min(low + (1 << level), pyramid_cells);
        real2 border = real2(mix(low, high, equal(forward, ivec2(1)))) - ray.from.xy;
        real2 reached = real2(
            moves.x ? border.x / ray.along.x : 1e30, moves.y ? border.y / ray.along.y : 1e30
        );
        real leave = clamp(min(reached.x, reached.y), t, ray.length);
        vec2 heights = texelFetch(pyramid, cell >> level, level).xy;
        real z0 = ray.from.z + t * ray.along.z, z1 = ray.from.z + leave * ray.along.z;
        if (min(z0, z1) > heights.y) {
            above = heights.x > 0.5 * UNMEASURED;
        } else if (max(z0, z1) < heights.x) {
            above = false;
        } else if (level > 0) {
            --level;
            continue;
        } else {
            real hit = hit_in_cell(ray, cell, t, leave, above, triangle);
            if (hit >= 0.0) return hit;
        }
        if (leave >= ray.length) break;
        t = leave;
        ivec2 here = clamp(ivec2(floor(ray.from.xy + t * ray.along.xy)), low, high - 1);
        ivec2 before = cell;
        cell = reached.x <= reached.y
            ? ivec2(forward.x == 1 ? high.x : low.x - 1, here.y)
            : ivec2(here.x, forward.y == 1 ? high.y : low.y - 1);
        if (any(lessThan(cell, ivec2(0))) || any(greaterThanEqual(cell, pyramid_cells))) break;
        // Up again only where a larger square was left.
        if (level < pyramid_top && (before >> (level + 1)) != (cell >> (level + 1))) ++level;
    }
    return real(-1.0);
}
