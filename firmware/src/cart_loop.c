#include "cart_loop.h"

#include <string.h>

#define BYTES_PER_POLL 64
#define LOOK_US 1000u /* between two looks at the cart's position */

static const uint8_t END_OF_TEXT = 0;

void cart_loop_boot(cart_loop *loop)
{
    cart_hardware_set_motor(0);
    memset(loop, 0, sizeof *loop);
    cart_boot(&loop->core);
    loop->clock_us = cart_hardware_clock_us();
    loop->end_us = loop->core.period_us;
    cart_hardware_write(&END_OF_TEXT, 1);
}

static void read_clock(cart_loop *loop)
{
    uint32_t clock_us = cart_hardware_clock_us();
    loop->now_us += (uint32_t)(clock_us - loop->clock_us);
    loop->clock_us = clock_us;
}

static void apply_motor(cart_loop *loop)
{
    cart_drive(&loop->core, loop->now_us);
    cart_hardware_set_motor(cart_motor(&loop->core));
}

static void receive(cart_loop *loop)
{
    uint8_t answer[CART_FRAME_BYTES];
    for (int bytes = 0; bytes < BYTES_PER_POLL; bytes++) {
        int byte = cart_hardware_read();
        size_t run;
        if (byte < 0)
            return;
        if (!cart_split(&loop->splitter, (uint8_t)byte, &run))
            continue;
        size_t length = cart_receive(&loop->core, loop->splitter.run, run, loop->now_us, answer);
        apply_motor(loop);
        if (length > 0)
            cart_hardware_write(answer, length);
    }
}

/* Deadlines do not drift. After a late period, the next one is skipped if at most half of it is left: a very
   short period would make speeds out of single counts. */
static void end_period(cart_loop *loop)
{
    uint8_t frames[2 * CART_FRAME_BYTES];
    read_clock(loop); /* the time of the measurement */
    int32_t cart_count = cart_hardware_cart_count();
    int32_t pole_count = cart_hardware_pole_count();
    size_t length = cart_tick(&loop->core, loop->now_us, cart_count, pole_count, frames);
    apply_motor(loop);
    cart_hardware_write(frames, length);
    cart_ask_policy(&loop->core);
    apply_motor(loop);
    loop->end_us += loop->core.period_us;
    if (loop->end_us <= loop->now_us + loop->core.period_us / 2)
        loop->end_us = loop->now_us + loop->core.period_us;
}

static void look(cart_loop *loop)
{
    if (loop->now_us - loop->looked_us < LOOK_US)
        return;
    loop->looked_us = loop->now_us;
#if CART_SWITCHES
    loop->core.switches = cart_hardware_switches();
#endif
    cart_look(&loop->core, loop->now_us, cart_hardware_cart_count(), cart_hardware_pole_count());
    apply_motor(loop);
}

bool cart_loop_poll(cart_loop *loop)
{
    read_clock(loop);
    look(loop);
    receive(loop);
    if (loop->now_us < loop->end_us)
        return false;
    end_period(loop);
    return true;
}
