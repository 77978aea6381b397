"""Each agent in a process of its own, with nothing but messages between them: how robots run the observers.

`agent.py` is one agent's loop, `robot.py` its plant, which hardware takes the place of; `transport.py`, `envelope.py`
and `receiver.py` are what its messages go through, `supervisor.py` starts and ends processes, and `collect.py` reads
what they have put on record. Nothing is imported here, so that an agent's process starts quickly.
"""
