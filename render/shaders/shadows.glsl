// Shadows that a painting's relief casts on itself: the search for triangles, towards the light.

uniform float shadow_lift;  // mm

// Whether nothing of the painting lies between a point of its surface and a light; canvas frame.
float unshadowed(vec3 point, vec3 to_light) {
    vec2 sides = vec2(pyramid_cells);
    vec2 place = clamp(texture_coordinate(point.xy) * (sides + 1.0) - 0.5, vec2(0.0), sides);
    ivec2 cell = min(ivec2(place), pyramid_cells - 1);
    // From above the triangle, because what is shown may lie a little under it: by the error of
    // heights, and as much as the cell's other diagonal would change. Noise and facets are no
    // relief, and cast no shadow.
    vec4 corners = corners_of(cell);
    bvec4 missing = lessThan(corners, vec4(0.5 * UNMEASURED));
    real3 triangle;
    vec3 from = vec3(place, point.z + shadow_lift);
    if (triangle_at(real4(corners), missing, real2(place - vec2(cell)), triangle)) {
        float twist = any(missing) ? 0.0 : 0.5 * abs(corners.x - corners.y - corners.z + corners.w);
        float surface = float(triangle.x + dot(triangle.yz, real2(place - vec2(cell))));
        from.z = max(point.z, surface + twist) + shadow_lift;
    }
    vec3 along = to_light * vec3(1.0, -1.0, texel) / texel;
    // To the light, or to where the ray leaves the box around the surface.
    vec3 border = mix(vec3(0.0), vec3(sides, 0.0), greaterThan(along, vec3(0.0)));
    border.z = along.z > 0.0 ? height_range.y : height_range.x;
    float leave = 1.0;
    for (int axis = 0; axis < 3; ++axis) {
        if (along[axis] != 0.0) leave = min(leave, (border[axis] - from[axis]) / along[axis]);
    }
    if (leave <= 0.0) return 1.0;
    int steps;
    Ray ray = Ray(real3(from), real3(along), real(leave));
    return first_hit(ray, steps, cell, triangle) < 0.0 ? 1.0 : 0.0;
}
