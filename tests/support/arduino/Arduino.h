/* A stand-in for the Arduino core: Serial is stdin and stdout, each new PWM value goes to stderr. */
#pragma once
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <poll.h>
#include <unistd.h>

enum { INPUT_PULLUP, OUTPUT, CHANGE };

inline unsigned long micros()
{
    static const auto begun = std::chrono::steady_clock::now();
    const auto passed = std::chrono::steady_clock::now() - begun;
    return (unsigned long)std::chrono::duration_cast<std::chrono::microseconds>(passed).count();
}
inline unsigned long millis() { return micros() / 1000; }
inline void pinMode(int, int) {}
inline int digitalRead(int) { return 0; }
inline int digitalPinToInterrupt(int pin) { return pin; }
inline void attachInterrupt(int, void (*)(), int) {}
inline void noInterrupts() {}
inline void interrupts() {}
inline void analogWrite(int pin, int value)
{
    static int last[64];
    if (last[pin] != value) fprintf(stderr, "%d %d\n", pin, last[pin] = value);
}

struct SerialPort {
    void begin(long) { setvbuf(stdout, nullptr, _IOLBF, 0); }
    int available()
    {
        pollfd input = {0, POLLIN, 0};
        return poll(&input, 1, 0) > 0 && (input.revents & POLLIN);
    }
    int read()
    {
        char letter;
        if (::read(0, &letter, 1) != 1) exit(0);
        return letter;
    }
    void print(unsigned long number) { printf("%lu", number); }
    void print(long number) { printf("%ld", number); }
    void print(char letter) { putchar(letter); }
    void println(long number) { printf("%ld\n", number); }
};
static SerialPort Serial;

void setup();
void loop();
int main()
{
    for (setup();; loop()) usleep(200);
}
