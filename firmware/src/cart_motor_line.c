#include "cart_motor_line.h"

static uint16_t slot(const cart_motor_line *line, uint32_t number)
{
    return (uint16_t)((line->first + number) % CART_PENDING);
}

void cart_line_command(cart_motor_line *line, uint64_t due_us, int16_t value)
{
    uint64_t newest_us = line->pending ? line->due_us[slot(line, line->pending - 1u)] : 0;
    if (line->pending < CART_PENDING)
        line->pending++;
    uint16_t last = slot(line, line->pending - 1u);
    line->due_us[last] = due_us > newest_us ? due_us : newest_us;
    line->values[last] = value;
}

void cart_line_stop(cart_motor_line *line, uint64_t now_us)
{
    while (line->pending && line->due_us[slot(line, line->pending - 1u)] > now_us)
        line->pending--;
    cart_line_command(line, now_us, 0);
}

void cart_line_hold(cart_motor_line *line, int16_t value)
{
    line->pending = 0;
    line->requested = value;
}

void cart_line_drive(cart_motor_line *line, uint64_t now_us)
{
    while (line->pending && line->due_us[line->first] <= now_us) {
        line->requested = line->values[line->first];
        line->first = slot(line, 1);
        line->pending--;
    }
}

uint64_t cart_line_next_due(const cart_motor_line *line, uint64_t before_us)
{
    if (line->pending == 0 || line->due_us[line->first] >= before_us)
        return before_us;
    return line->due_us[line->first];
}
