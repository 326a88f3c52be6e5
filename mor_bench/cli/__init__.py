"""The command line: each command is one call of a public function.

Here live the commands, the console, progress bars and the template of a new method. Nothing here
computes: a command reads its options, calls the library, and prints.

`app.py` lists the commands and is the place to start reading. It imports the file of a command only
when the command is used, so `mor-bench --help` starts at once. Therefore the files of commands
import whatever they need at their top.
"""
