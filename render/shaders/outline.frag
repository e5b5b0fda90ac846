// Shadow maps: light passes gaps.
in vec2 place;

void main() {
    if (textureLod(relief_map, place, 0.0).w < 0.5) discard;
}
