"""Processes of a deployment on this machine: started, killed, started again, and measured."""
