// What every mode shares: the maps of the copy, the lights of the scene, and eq. 1 of the paper.

#define MAX_LIGHTS 8
const float PI = 3.14159265358979;

struct PointLight { vec3 color; float intensity; vec3 position; };
struct DirectionalLight { vec3 color; float intensity; vec3 direction; };
// The cone's fall-off is pyrender's: (cos angle · scale + offset)², between 0 and 1.
struct SpotLight {
    vec3 color; float intensity; vec3 position; vec3 direction;
    float light_angle_scale; float light_angle_offset;
};

uniform sampler2D relief_map;    // height in mm, n_x, n_y, mask
uniform sampler2D diffuse_map;
uniform sampler2D specular_map;
uniform sampler2D lobe_map;      // C_x, C_y, C_z, k
uniform bool has_reflectance;
uniform vec2 grid_corner;        // X and Y of the top left corner of the grid, mm
uniform vec2 grid_size;          // width and height of the grid, mm
uniform vec2 height_range;       // lowest and highest height, mm
uniform float delta0;
uniform mat4 M;
uniform mat4 P;
uniform mat4 V;
uniform vec3 cam_pos;

uniform vec3 ambient_light;
uniform int n_point_lights;
uniform int n_directional_lights;
uniform PointLight point_lights[MAX_LIGHTS];
uniform DirectionalLight directional_lights[MAX_LIGHTS];
uniform int n_spot_lights;
uniform SpotLight spot_lights[MAX_LIGHTS];

out vec4 frag_color;

vec2 texture_coordinate(vec2 xy) {
    return vec2((xy.x - grid_corner.x) / grid_size.x, (grid_corner.y - xy.y) / grid_size.y);
}

// M moves the canvas rigidly, so its inverse is cheap.
vec3 to_canvas(vec3 world) { return transpose(mat3(M)) * (world - M[3].xyz); }
vec3 direction_to_canvas(vec3 world) { return transpose(mat3(M)) * world; }

float depth_of(vec3 canvas_point) {
    vec4 clip = P * V * M * vec4(canvas_point, 1.0);
    return 0.5 * clip.z / clip.w + 0.5;
}

vec3 reflectance(vec2 uv, vec3 v, vec3 l) {
    if (!has_reflectance) return vec3(0.8 / PI);
    vec4 lobe = texture(lobe_map, uv);
    float d = dot(lobe.xyz, v * l);
    float highlight = d > 0.0 ? pow(d, lobe.w) : 0.0;
    return texture(diffuse_map, uv).rgb + texture(specular_map, uv).rgb * highlight;
}

vec3 ambient_reflectance(vec2 uv) {
    return has_reflectance ? texture(diffuse_map, uv).rgb : vec3(0.8 / PI);
}

// Radiance by a light at a place, with the intensity it has in this direction.
vec3 lit_from(vec3 place, vec3 intensity, vec3 point, vec2 uv, vec3 v, mat3 to_local) {
    vec3 to_light = to_canvas(place) - point;
    float r2 = dot(to_light, to_light);
    vec3 l = to_local * (to_light * inversesqrt(r2));
    return reflectance(uv, v, l) * intensity * max(l.z, 0.0) / r2;
}

float cone(SpotLight light, vec3 point) {
    vec3 from_light = normalize(point - to_canvas(light.position));
    float cosine = clamp(dot(direction_to_canvas(light.direction), from_light), 0.0, 1.0);
    float edge = clamp(cosine * light.light_angle_scale + light.light_angle_offset, 0.0, 1.0);
    return edge * edge;
}

// Radiance leaving a surface point towards the camera; point and normal in the canvas frame.
vec3 shade(vec3 point, vec2 uv) {
    vec2 nxy = texture(relief_map, uv).yz;
    vec3 n = vec3(nxy, sqrt(max(0.0, 1.0 - dot(nxy, nxy))));
    // Local frame of eq. 1: the canvas X axis laid into the tangent plane.
    vec3 t = normalize(vec3(1.0, 0.0, 0.0) - n.x * n);
    mat3 to_local = transpose(mat3(t, cross(n, t), n));
    vec3 v = to_local * normalize(to_canvas(cam_pos) - point);
    vec3 radiance = PI * ambient_reflectance(uv) * ambient_light;
    for (int i = 0; i < n_point_lights; ++i) {
        vec3 intensity = point_lights[i].color * point_lights[i].intensity;
        radiance += lit_from(point_lights[i].position, intensity, point, uv, v, to_local);
    }
    for (int i = 0; i < n_spot_lights; ++i) {
        vec3 intensity = spot_lights[i].color * spot_lights[i].intensity;
        intensity *= cone(spot_lights[i], point);
        radiance += lit_from(spot_lights[i].position, intensity, point, uv, v, to_local);
    }
    for (int i = 0; i < n_directional_lights; ++i) {
        vec3 l = to_local * direction_to_canvas(-directional_lights[i].direction);
        vec3 irradiance =
            directional_lights[i].color * directional_lights[i].intensity * max(l.z, 0.0);
        radiance += reflectance(uv, v, l) * irradiance;
    }
    return radiance;
}
