#version 410 core
// Linear radiance for the screen: the mean of a pixel's samples, as sRGB (IEC 61966-2-1), under a
// caption.
uniform sampler2D radiance;
uniform int samples;  // along each axis
uniform float exposure;
uniform sampler2D caption;
uniform bool has_caption;
out vec4 frag_color;

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * samples;
    vec3 sum = vec3(0.0);
    for (int y = 0; y < samples; ++y) {
        for (int x = 0; x < samples; ++x) {
            sum += texelFetch(radiance, first + ivec2(x, y), 0).rgb;
        }
    }
    vec3 linear = clamp(exposure * sum / float(samples * samples), 0.0, 1.0);
    vec3 curved = 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055;
    vec3 shown = mix(12.92 * linear, curved, greaterThan(linear, vec3(0.0031308)));
    if (has_caption) {
        int row = textureSize(caption, 0).y - 1 - int(gl_FragCoord.y);
        vec4 text = texelFetch(caption, ivec2(gl_FragCoord.x, row), 0);
        shown = mix(shown, text.rgb, text.a);
    }
    frag_color = vec4(shown, 1.0);
}
