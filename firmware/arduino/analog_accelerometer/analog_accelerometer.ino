// An analogue accelerometer (such as an ADXL335) on A0, A1, A2 of an Arduino Uno. Sends 400 lines a
// second: a counter and three values, 0 to 1023. The counter shows exactly which lines are lost.

const uint32_t PERIOD_US = 2500;
uint16_t count = 0;
uint32_t due_us;

void setup() {
  Serial.begin(115200);
  Serial.println(F("n,ax,ay,az"));
  due_us = micros();
}

void loop() {
  while ((int32_t)(micros() - due_us) < 0) {
  }
  due_us += PERIOD_US;
  int x = analogRead(A0), y = analogRead(A1), z = analogRead(A2);
  Serial.print(count++);
  Serial.print(',');
  Serial.print(x);
  Serial.print(',');
  Serial.print(y);
  Serial.print(',');
  Serial.println(z);
}
