static float clamped(float value, float low, float high)
{
    if (isnan(value) || isnan(low) || isnan(high)) {
        return NAN;
    }
    return value > low ? (value < high ? value : high) : (low < high ? low : high);
}
