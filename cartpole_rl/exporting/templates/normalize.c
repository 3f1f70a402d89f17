static void normalize(float *units, int count, const float *gain, const float *shift)
{
    float mean = 0.0f;
    float variance = 0.0f;
    for (int i = 0; i < count; i++) {
        mean += units[i];
    }
    mean /= (float)count;
    for (int i = 0; i < count; i++) {
        units[i] -= mean;
        variance += units[i] * units[i];
    }
    const float scale = 1.0f / sqrtf(variance / (float)count + @@epsilon@@);
    for (int i = 0; i < count; i++) {
        units[i] = gain[i] * (units[i] * scale) + shift[i];
    }
}
