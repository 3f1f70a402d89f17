static float sign(float value)
{
    return (float)(value > 0.0f) - (float)(value < 0.0f);
}
