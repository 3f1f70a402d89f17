static void rectify(float *units, int count)
{
    for (int i = 0; i < count; i++) {
        units[i] = units[i] < 0.0f ? 0.0f : units[i];
    }
}
