/* Hardware for the cart's main loop that a test sets: clock, counts, bytes from the host. */
#include "cart_loop.h"

#include <string.h>

#define ROOM 65536

static cart_loop loop;
static uint32_t clock_us;
static int16_t motor;
static uint8_t input[ROOM], output[ROOM];
static size_t input_length, input_at, output_length;
static size_t written_when_asked;

static int16_t policy(void *memory, const cart_observation *observation)
{
    (void)memory;
    (void)observation;
    written_when_asked = output_length;
    return 100;
}

uint32_t cart_hardware_clock_us(void)
{
    return clock_us;
}

int32_t cart_hardware_cart_count(void)
{
    return 0;
}

int32_t cart_hardware_pole_count(void)
{
    return 0;
}

#if CART_SWITCHES
static uint8_t switches;

uint8_t cart_hardware_switches(void)
{
    return switches;
}

void bench_press(uint8_t pressed)
{
    switches = pressed;
}
#endif

void cart_hardware_set_motor(int16_t value)
{
    motor = value;
}

int cart_hardware_read(void)
{
    return input_at < input_length ? input[input_at++] : -1;
}

void cart_hardware_write(const uint8_t *frame, size_t length)
{
    memcpy(output + output_length, frame, length);
    output_length += length;
}

void bench_boot(uint32_t now_us)
{
    clock_us = now_us;
    motor = 0;
    input_length = input_at = output_length = written_when_asked = 0;
    memset(&loop, 0, sizeof loop);
    cart_loop_boot(&loop);
    loop.core.policy = policy;
    loop.core.homed = true;
}

void bench_send(const uint8_t *bytes, size_t length)
{
    memcpy(input + input_length, bytes, length);
    input_length += length;
}

/* Poll at a time of the clock; return true if the period ended. */
bool bench_poll(uint32_t now_us)
{
    clock_us = now_us;
    return cart_loop_poll(&loop);
}

int16_t bench_motor(void)
{
    return motor;
}

size_t bench_written_when_asked(void)
{
    return written_when_asked;
}

/* Copy all bytes to the host; return how many there are. */
size_t bench_output(uint8_t *bytes)
{
    memcpy(bytes, output, output_length);
    return output_length;
}
