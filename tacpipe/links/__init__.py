"""What carries a sensor's bytes: serial ports, HID, UDP, TCP, websockets, CAN, a watched folder. One kind a file."""
