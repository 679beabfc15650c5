// An Arduino Uno in simavr, in real time: its converter reads voltages from files, its serial port
// is a pseudo-terminal.
//
// uno ELF
//
// Prints the path of the pseudo-terminal. Each line on standard input names a file to play from then
// on: 16-bit little-endian millivolts of A0, A1 and A2, RATE_HZ times a second. At rest, and after a
// file, each is at REST_MV with a little noise. Ends with standard input.
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_adc.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

enum { CHANNELS = 3, RATE_HZ = 2000, F_CPU_HZ = 16000000, REST_MV = 2500, STEP_MS = 2 };

static avr_t *avr;
static int line;
static char sent[4096];
static size_t waiting;
// The file that is played, and the cycle at which it began.
static int16_t *tape;
static size_t frames;
static avr_cycle_count_t began;

static void fail(const char *what) {
  fprintf(stderr, "uno: %s\n", what);
  exit(1);
}

// The converter samples a channel.
static void convert(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)param;
  union {
    avr_adc_mux_t mux;
    uint32_t v;
  } asked = {.v = value};
  int channel = asked.mux.src;
  int mv = REST_MV + rand() % 11 - 5;
  size_t frame = (avr->cycle - began) * RATE_HZ / F_CPU_HZ;
  if (tape && frame < frames && channel < CHANNELS) mv = tape[frame * CHANNELS + channel];
  avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0 + channel), mv);
}

// The serial port has sent a byte.
static void transmit(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)param;
  if (waiting < sizeof sent) sent[waiting++] = value;
}

// Takes the name of a file from standard input; 0 at its end.
static int command(void) {
  struct pollfd in = {.fd = 0, .events = POLLIN};
  if (poll(&in, 1, 0) == 0) return 1;
  char path[4096];
  if (!fgets(path, sizeof path, stdin)) return 0;
  path[strcspn(path, "\n")] = 0;
  FILE *file = fopen(path, "rb");
  if (!file) fail("cannot open the file to play");
  fseek(file, 0, SEEK_END);
  frames = ftell(file) / (CHANNELS * sizeof *tape);
  rewind(file);
  tape = realloc(tape, frames * CHANNELS * sizeof *tape);
  if (fread(tape, CHANNELS * sizeof *tape, frames, file) != frames) fail("cannot read the file");
  fclose(file);
  began = avr->cycle;
  return 1;
}

int main(int argc, char **argv) {
  elf_firmware_t firmware = {0};
  if (argc != 2 || elf_read_firmware(argv[1], &firmware)) fail("expected an ELF file");
  avr = avr_make_mcu_by_name("atmega328p");
  if (!avr) fail("simavr has no atmega328p");
  avr_init(avr);
  firmware.frequency = F_CPU_HZ;
  avr_load_firmware(avr, &firmware);
  avr->vcc = avr->avcc = avr->aref = 5000;
  uint32_t flags = 0;
  avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
  flags &= ~AVR_UART_FLAG_STDIO;
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_OUT_TRIGGER), convert,
                          NULL);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), transmit,
                          NULL);

  int slave;
  char path[256];
  struct termios raw;
  if (openpty(&line, &slave, path, NULL, NULL)) fail("there is no pseudo-terminal");
  tcgetattr(slave, &raw);
  cfmakeraw(&raw);
  tcsetattr(slave, TCSANOW, &raw);
  // Like a port, which does not wait for its reader.
  fcntl(line, F_SETFL, O_NONBLOCK);
  printf("%s\n", path);
  fflush(stdout);

  struct timespec due;
  clock_gettime(CLOCK_MONOTONIC, &due);
  for (avr_cycle_count_t until = 0; command();) {
    until += (avr_cycle_count_t)STEP_MS * F_CPU_HZ / 1000;
    while (avr->cycle < until) {
      int state = avr_run(avr);
      if (state == cpu_Done || state == cpu_Crashed) fail("the program has ended");
    }
    if (waiting && write(line, sent, waiting) < 0) { /* nobody reads: lost, as on a real line */
    }
    waiting = 0;
    due.tv_nsec += STEP_MS * 1000000;
    due.tv_sec += due.tv_nsec / 1000000000;
    due.tv_nsec %= 1000000000;
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
  }
  return 0;
}
