// What every mode shares: the maps of the copy, the lights of the scene, and eq. 1 of the paper.

#define MAX_LIGHTS 8
const float PI = 3.14159265358979;

struct PointLight { vec3 color; float intensity; vec3 position; };
struct DirectionalLight { vec3 color; float intensity; vec3 direction; };
// The cone's fall-off is pyrender's: (cos angle · scale + offset)², between 0 and 1.
struct SpotLight {
    vec3 color; float intensity; vec3 position; vec3 direction;
    float light_angle_scale; float light_angle_offset;
#ifdef SHADOWS
    sampler2D shadow_map; mat4 light_matrix;
#endif
};

// What is written: 0 radiance, 1 the point that was hit, 2 how much work it was.
#ifndef SHOWN
#define SHOWN 0
#endif
#if SHOWN == 2
#define MISS(steps) { frag_color = vec4(float(steps), 1.0, 0.0, 0.0); return; }
#else
#define MISS(steps) discard
#endif

uniform sampler2D relief_map;    // height in mm, n_x, n_y, mask
uniform sampler2D diffuse_map;
uniform sampler2D specular_map;
uniform sampler2D lobe_map;      // C_x, C_y, C_z, k
uniform bool has_reflectance;
uniform vec2 grid_corner;        // X and Y of the top left corner of the grid, mm
uniform vec2 grid_size;          // width and height of the grid, mm
uniform vec2 height_range;       // lowest and highest height, mm
uniform float delta0;
uniform float texel;             // mm
uniform float pixel_angle;       // radians, at the middle of the picture
uniform mat4 M;
uniform mat4 P;
uniform mat4 V;
uniform vec4 depth_row;          // of P V M, for the depth in the canvas frame
uniform vec4 w_row;
uniform vec3 cam_pos;

uniform vec3 ambient_light;
uniform int n_point_lights;
uniform int n_directional_lights;
uniform PointLight point_lights[MAX_LIGHTS];
uniform DirectionalLight directional_lights[MAX_LIGHTS];
uniform int n_spot_lights;
uniform SpotLight spot_lights[MAX_LIGHTS];

out vec4 frag_color;

#ifdef SHADOWS
uniform vec3 ambient_slope;      // relative change of ambient light along the world's axes
float unshadowed(vec3 point, vec3 to_light);
float soft_light(mat4 light_matrix, sampler2D shadow_map, vec3 place, vec3 normal);
#endif

vec2 texture_coordinate(vec2 xy) {
    return vec2((xy.x - grid_corner.x) / grid_size.x, (grid_corner.y - xy.y) / grid_size.y);
}

// M moves the canvas rigidly, so its inverse is cheap.
vec3 to_canvas(vec3 world) { return transpose(mat3(M)) * (world - M[3].xyz); }
vec3 direction_to_canvas(vec3 world) { return transpose(mat3(M)) * world; }

// Level of the maps at which a texel is as large as a pixel's area on the canvas. Not from
// derivatives: they mean nothing where neighbouring pixels hit different things.
float level_of_detail(vec3 point) {
    vec3 to_eye = to_canvas(cam_pos) - point;
    float d2 = dot(to_eye, to_eye);
    float cosine = max(abs(to_eye.z) * inversesqrt(d2), 0.05);
    return max(0.5 * log2(pixel_angle * pixel_angle * d2 / (texel * texel * cosine)), 0.0);
}

float depth_of(vec3 canvas_point) {
    return 0.5 * dot(depth_row, vec4(canvas_point, 1.0)) / dot(w_row, vec4(canvas_point, 1.0)) + 0.5;
}

// Eq. 1's parameters at a place.
struct Paint { vec3 diffuse; vec3 specular; vec4 lobe; };

Paint paint_at(vec2 uv, float level) {
    if (!has_reflectance) return Paint(vec3(0.8 / PI), vec3(0.0), vec4(0.0, 0.0, 0.0, 1.0));
    return Paint(
        textureLod(diffuse_map, uv, level).rgb,
        textureLod(specular_map, uv, level).rgb,
        textureLod(lobe_map, uv, level)
    );
}

vec3 reflectance(Paint paint, vec3 v, vec3 l) {
    float d = dot(paint.lobe.xyz, v * l);
    float highlight = d > 0.0 ? pow(d, paint.lobe.w) : 0.0;
    return paint.diffuse + paint.specular * highlight;
}

// Radiance by a light at a place, with the intensity it has in this direction.
vec3 lit_from(vec3 place, vec3 intensity, vec3 point, Paint paint, vec3 v, mat3 to_local) {
    vec3 to_light = to_canvas(place) - point;
    float r2 = dot(to_light, to_light);
    vec3 l = to_local * (to_light * inversesqrt(r2));
#ifdef SHADOWS
    if (l.z <= 0.0 || intensity == vec3(0.0)) return vec3(0.0);
    intensity *= unshadowed(point, to_light);
#endif
    return reflectance(paint, v, l) * intensity * max(l.z, 0.0) / r2;
}

float cone(SpotLight light, vec3 point) {
    vec3 from_light = normalize(point - to_canvas(light.position));
    float cosine = clamp(dot(direction_to_canvas(light.direction), from_light), 0.0, 1.0);
    float edge = clamp(cosine * light.light_angle_scale + light.light_angle_offset, 0.0, 1.0);
    return edge * edge;
}

// Radiance leaving a surface point towards the camera; point and normal in the canvas frame.
vec3 shade(vec3 point, vec2 uv, vec4 relief, float level) {
    vec3 n = vec3(relief.yz, sqrt(max(0.0, 1.0 - dot(relief.yz, relief.yz))));
    // Local frame of eq. 1: the canvas X axis laid into the tangent plane.
    vec3 t = normalize(vec3(1.0, 0.0, 0.0) - n.x * n);
    mat3 to_local = transpose(mat3(t, cross(n, t), n));
    vec3 v = to_local * normalize(to_canvas(cam_pos) - point);
    Paint paint = paint_at(uv, level);
    vec3 radiance = PI * paint.diffuse * ambient_light;
#ifdef SHADOWS
    radiance *= 1.0 + dot(mat3(M) * n, ambient_slope);
#endif
    for (int i = 0; i < n_point_lights; ++i) {
        vec3 intensity = point_lights[i].color * point_lights[i].intensity;
        radiance += lit_from(point_lights[i].position, intensity, point, paint, v, to_local);
    }
    for (int i = 0; i < n_spot_lights; ++i) {
        vec3 intensity = spot_lights[i].color * spot_lights[i].intensity;
        intensity *= cone(spot_lights[i], point);
#ifdef SHADOWS
        if (intensity != vec3(0.0)) {
            vec3 place = (M * vec4(point, 1.0)).xyz;
            intensity *= soft_light(
                spot_lights[i].light_matrix, spot_lights[i].shadow_map, place, M[2].xyz
            );
        }
#endif
        radiance += lit_from(spot_lights[i].position, intensity, point, paint, v, to_local);
    }
    for (int i = 0; i < n_directional_lights; ++i) {
        vec3 l = to_local * direction_to_canvas(-directional_lights[i].direction);
        vec3 irradiance =
            directional_lights[i].color * directional_lights[i].intensity * max(l.z, 0.0);
#ifdef SHADOWS
        vec3 away = -1e6 * direction_to_canvas(directional_lights[i].direction);
        if (l.z > 0.0) irradiance *= unshadowed(point, away);
#endif
        radiance += reflectance(paint, v, l) * irradiance;
    }
    return radiance;
}

// The fragment of a point that was hit, by its shape and paint at a level of the maps.
void show(vec3 point, vec2 uv, vec4 relief, float level, float alpha, int steps) {
#if SHOWN == 0
    frag_color = vec4(shade(point, uv, relief, level), alpha);
#elif SHOWN == 1
    frag_color = vec4(point, alpha);
#else
    frag_color = vec4(float(steps), 1.0, 0.0, 0.0);
#endif
}
