static void linear(const float *weight, const float *bias, const float *input, int inputs, float *output, int outputs)
{
    for (int row = 0; row < outputs; row++) {
        float sum = bias[row];
        for (int column = 0; column < inputs; column++) {
            sum += weight[row * inputs + column] * input[column];
        }
        output[row] = sum;
    }
}
