"""Read and write a sensor's bytes over serial ports, HID, UDP, TCP, websockets, CAN, LSL, cameras and watched folders."""
