"""The command line, `tdf`: one file a command, named as the command.

Modules:
    main: the commands, and errors as messages
    options: options that commands share
    scenes: objects and demonstrations, read from files or generated
    imitation_record: what `tdf imitate` says of a run: result.json and the printed table
    camera: depth images, and the object that they show
    pictures: optional outputs, which may fail
    streams: standard output and error, which may fail
    episodes: rows of simulated episodes beside published ones
    pairs: objects placed on targets by the library and by baselines
    attempts: the folder of what a benchmark has computed
    targets: the objects of a folder, one after the other
    tasks: generated objects and targets
"""
