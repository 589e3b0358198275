"""Emulator of a Roomba 600 at its serial port: the Open Interface's modes, commands, sensors and stream.

Pure: bytes, times and the state of the world go in, bytes and wheel speeds come out.
Source: iRobot Create 2 Open Interface specification based on the Roomba 600 (2018). Where it is silent:
a byte that is no opcode is ignored; speeds and radii out of range are clamped; Spot, Clean and Max, the button CLEAN
(`press_clean`) and the schedule (`clean`) let it drive off in Passive mode; Seek Dock drives it to the
dock that the simulation describes by `set_dock`;
Power puts the robot to sleep in Passive mode with its stream off; the encoders survive everything but Reset.
What owners report of single robots is in `Quirks`. Not emulated: the five minutes after which Passive mode sleeps (set
`asleep`), songs, LEDs, brushes, the command for another baud rate (they are accepted and have no effect).
"""

from robot_agent.bases.roomba600.emulator.body import Battery, Quirks
from robot_agent.bases.roomba600.emulator.robot import BOOT_TEXT, FULL, OFF, PASSIVE, SAFE, RoombaEmulator

__all__ = ["BOOT_TEXT", "FULL", "OFF", "PASSIVE", "SAFE", "Battery", "Quirks", "RoombaEmulator"]
