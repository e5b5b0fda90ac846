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
uniform sampler2D pyramid;  // least and greatest height of squares of cells, and if nothing is missing
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
struct Ray { real3 from; real3 along; real length; };

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
    real2 start = ray.from.xy - real2(cell);
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

// Where a ray is: the cell, the level of the square around it, and the places of entry and exit.
struct Walk { ivec2 cell; int level; real enter; real leave; bvec2 crosses; ivec2 low; ivec2 high; };

// On into the next square; false where the ray ends or leaves the cells.
bool go_on(Ray ray, bvec2 forward, inout Walk walk) {
    if (walk.leave >= ray.length) return false;
    walk.enter = walk.leave;
    ivec2 here = ivec2(floor(ray.from.xy + walk.enter * ray.along.xy));
    ivec2 before = walk.cell;
    ivec2 beyond = ivec2(mix(walk.low - 1, walk.high, forward));
    walk.cell = ivec2(mix(clamp(here, walk.low, walk.high - 1), beyond, walk.crosses));
    // Up again only where a larger square was left.
    int larger = walk.level + 1;
    if (larger <= pyramid_top && (before >> larger) != (walk.cell >> larger)) walk.level = larger;
    return all(greaterThanEqual(walk.cell, ivec2(0))) && all(lessThan(walk.cell, pyramid_cells));
}

// Place of the first hit along the ray; below zero where there is none.
real first_hit(Ray ray, out int steps, out ivec2 cell, out real3 triangle) {
    bvec2 forward = greaterThanEqual(ray.along.xy, real2(0.0));
    // A ray that does not move is never across.
    real2 slow = max(abs(ray.along.xy), real2(1e-30));
    real2 per_texel = real2(forward.x ? 1.0 : -1.0, forward.y ? 1.0 : -1.0) / slow;
    Walk walk;
    walk.cell = clamp(ivec2(floor(ray.from.xy)), ivec2(0), pyramid_cells - 1);
    // Larger squares than the ray runs over are only looked into.
    real across = ray.length * max(abs(ray.along.x), abs(ray.along.y));
    walk.level = clamp(int(log2(max(float(across), 1.0))), 0, pyramid_top);
    walk.enter = 0.0;
    bool above = false, under_way = true;
    steps = 0;
    real hit = -1.0;
    // Without a graphics card both branches of every condition are gone through, and only loops are
    // not: so squares are passed in a loop of their own, and cells looked into outside it.
    while (under_way) {
        bool near = false;
        while (under_way && !near) {
            walk.low = (walk.cell >> walk.level) << walk.level;
            walk.high = min(walk.low + (1 << walk.level), pyramid_cells);
            real2 border = real2(mix(walk.low, walk.high, forward)) - ray.from.xy;
            real2 reached = border * per_texel;
            walk.crosses = bvec2(reached.x <= reached.y, reached.x > reached.y);
            walk.leave = clamp(min(reached.x, reached.y), walk.enter, ray.length);
            vec3 heights = texelFetch(pyramid, walk.cell >> walk.level, walk.level).xyz;
            real z0 = ray.from.z + walk.enter * ray.along.z;
            real z1 = ray.from.z + walk.leave * ray.along.z;
            bool over = min(z0, z1) > heights.y, under = max(z0, z1) < heights.x;
            if (over || under) {
                above = over && heights.z > 0.5;
                under_way = go_on(ray, forward, walk);
            } else {
                near = walk.level == 0;
                walk.level = max(walk.level - 1, 0);
            }
            under_way = under_way && ++steps < 16384;
        }
        if (near) {
            hit = hit_in_cell(ray, walk.cell, walk.enter, walk.leave, above, triangle);
            cell = walk.cell;
            under_way = under_way && hit < 0.0 && go_on(ray, forward, walk);
        }
    }
    return hit;
}
