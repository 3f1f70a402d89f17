/* The core as a shared library for the emulated cart, and its whole state as numbers for comparisons. */
#include "library.h"

#include <string.h>

#ifdef CART_ONBOARD_POLICY
#define CART_POLE_LENGTH 0.0f /* not read: cart_attach_policy gives it */
#include "onboard.h"
#endif

size_t cart_policy_size(void)
{
#ifdef CART_ONBOARD_POLICY
    return sizeof(onboard_memory);
#else
    return 0;
#endif
}

void cart_attach_policy(cart *self, void *memory, float length)
{
#ifdef CART_ONBOARD_POLICY
    onboard_attach_memory(self, (onboard_memory *)memory, length);
#else
    (void)self;
    (void)memory;
    (void)length;
#endif
}

size_t cart_size(void)
{
    return sizeof(cart);
}

void cart_delay_command(cart *self, uint64_t due_us)
{
    cart_motor_line *line = &self->line;
    uint64_t *newest_us = &line->due_us[(line->first + line->pending - 1u) % CART_PENDING];
    if (due_us > *newest_us)
        *newest_us = due_us;
}

size_t cart_runs(cart_splitter *splitter, const uint8_t *bytes, size_t count, uint8_t *runs)
{
    size_t written = 0, length;
    for (size_t at = 0; at < count; at++) {
        if (!cart_split(splitter, bytes[at], &length))
            continue;
        runs[written++] = (uint8_t)length;
        memcpy(runs + written, splitter->run, length);
        written += length;
    }
    return written;
}

typedef struct {
    int64_t *numbers;
    size_t count;
} list;

static void add(list *all, int64_t number)
{
    all->numbers[all->count++] = number;
}

static int64_t bits(double number)
{
    int64_t same;
    memcpy(&same, &number, sizeof same);
    return same;
}

static void add_core(list *all, const cart *self)
{
    add(all, self->period_us);
    add(all, self->armed);
    add(all, self->homed);
    add(all, self->homing);
    add(all, self->fault);
    add(all, self->reported);
    add(all, self->last_sequence);
    add(all, self->sequence);
    add(all, self->ticks);
    for (size_t tick = 0; tick < CART_WATCHDOG_PERIODS + 1; tick++)
        add(all, (int64_t)self->measured_us[tick]);
    add(all, self->commanded);
    add(all, (int64_t)self->command_us);
    add(all, (int64_t)self->expires_us);
    add(all, (int64_t)self->heard_us);
    add(all, self->zeros.left_stop);
    add(all, self->zeros.right_stop);
    add(all, self->zeros.hanging);
    add(all, self->pole_zero);
    add(all, self->line.requested);
    add(all, self->line.pending);
    add(all, self->seen);
    add(all, self->procedure.pressed);
    add(all, self->procedure.pressed_at);
    add(all, self->homing ? self->procedure.waited_us : 0);
}

static void add_limits(list *all, const cart *self)
{
    const cart_limits *limits = &self->limits;
    add(all, self->limited);
    add(all, self->cart_count);
    add(all, self->pole_count);
    add(all, limits->blocked);
    add(all, limits->brake);
    add(all, (int64_t)limits->until_us);
    add(all, (int64_t)limits->moved_us);
    add(all, (int64_t)limits->blind_us);
    add(all, (int64_t)limits->looked_us);
    add(all, limits->counted);
    add(all, limits->counted ? limits->count : 0);
    add(all, limits->speed_um);
    add(all, limits->way_nm);
    add(all, limits->sampled);
    add(all, limits->fresh);
    for (size_t age = 0; age < CART_SPEED_SAMPLES; age++) {
        size_t slot = (limits->newest + CART_SPEED_SAMPLES - age) % CART_SPEED_SAMPLES;
        add(all, age < limits->sampled ? (int64_t)limits->us[slot] : 0);
        add(all, age < limits->sampled ? limits->carts[slot] : 0);
        add(all, age < limits->sampled ? limits->poles[slot] : 0);
    }
}

static void add_guards(list *all, const cart_guards *guards)
{
    const cart_stall_watch *stalls = &guards->stalls;
    const cart_frozen_cart_watch *cart_freezes = &guards->cart_freezes;
    const cart_frozen_pole_watch *pole_freezes = &guards->pole_freezes;
    add(all, stalls->direction);
    add(all, stalls->direction ? stalls->anchor : 0);
    add(all, stalls->pushed_us);
    add(all, guards->cart_jumps.counted);
    add(all, guards->cart_jumps.last);
    add(all, guards->pole_jumps.counted);
    add(all, guards->pole_jumps.last);
    add(all, cart_freezes->counted);
    add(all, cart_freezes->count);
    add(all, cart_freezes->direction);
    add(all, cart_freezes->lasts_us);
    add(all, cart_freezes->right_us);
    add(all, cart_freezes->left_us);
    add(all, pole_freezes->counted);
    add(all, pole_freezes->pole);
    add(all, pole_freezes->cart);
    add(all, pole_freezes->elapsed_us);
    add(all, pole_freezes->moved);
    add(all, pole_freezes->lowest);
    add(all, pole_freezes->highest);
    add(all, pole_freezes->rise);
    add(all, pole_freezes->fall);
}

/* Both ways to the middle count as one stage. */
static int64_t stage_number(cart_homing_stage stage)
{
    return stage == CART_CENTRE_AGAIN ? CART_CENTRE : stage;
}

static void add_homing(list *all, const cart *self)
{
    const cart_homing *homing = &self->procedure;
    bool under_way = self->homing && homing->entered;
    bool full = under_way && homing->window.full;
    bool searched = homing->stage == CART_FIND_HANGING || homing->stage == CART_BRAKE;
    add(all, under_way ? stage_number(homing->stage) : 0);
    add(all, under_way ? homing->elapsed_us : 0);
    add(all, under_way ? bits(homing->servo.reference) : 0);
    add(all, under_way ? bits(homing->servo.integral) : 0);
    add(all, under_way ? homing->window.used : 0);
    add(all, full ? cart_window_spread(&homing->window) : -1);
    add(all, under_way && searched ? homing->zeros.hanging : 0);
    add(all, under_way && homing->stage == CART_BRAKE ? homing->widest : 0);
}

void cart_snapshot(const cart *self, int64_t *numbers)
{
    list all = {numbers, 0};
    add_core(&all, self);
    add_limits(&all, self);
    add_guards(&all, &self->guards);
    add_homing(&all, self);
}
