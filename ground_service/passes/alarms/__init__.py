"""Alarms: raised by event reports and broken limits, kept until an operator has acknowledged them."""
