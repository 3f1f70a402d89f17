/* Compiled with arm-none-eabi-gcc 12.2; run in QEMU as part of boards/qemu_an386.

   Reset of a Cortex-M4 with a floating-point unit: vectors, data, and a stop with the motor off. */
#include <stdint.h>

#define CPACR (*(volatile uint32_t *)0xE000ED88u)
#define AIRCR (*(volatile uint32_t *)0xE000ED0Cu)

extern uint32_t data_image[], data_start[], data_end[], bss_start[], bss_end[], stack_end[];

int main(void);
void reset(void);

/* A fault or an unexpected interrupt resets the board, which switches the motor off. */
static void unexpected(void)
{
    AIRCR = 0x05FA0004u;
    for (;;)
        continue;
}

void usart2_interrupt(void) __attribute__((weak, alias("unexpected")));
void uart0_interrupt(void) __attribute__((weak, alias("unexpected")));
void systick_interrupt(void) __attribute__((weak, alias("unexpected")));

typedef void (*handler)(void);

__attribute__((section(".vectors"), used)) static const union {
    uint32_t *stack;
    handler function;
} VECTORS[16 + 64] = {
    {.stack = stack_end},
    {.function = reset},
    [2 ... 14] = {.function = unexpected},
    [15] = {.function = systick_interrupt},
    [16] = {.function = uart0_interrupt},
    [17 ... 53] = {.function = unexpected},
    [54] = {.function = usart2_interrupt},
    [55 ... 79] = {.function = unexpected},
};

void reset(void)
{
    CPACR |= 0xFu << 20; /* the floating-point unit */
    __asm volatile("dsb\n isb");
    for (uint32_t *from = data_image, *to = data_start; to < data_end; from++, to++)
        *to = *from;
    for (uint32_t *to = bss_start; to < bss_end; to++)
        *to = 0;
    main();
    unexpected();
}
