"""`tdf view`: an imitation or a landscape in a browser, with an object and a goal to drag. It needs the extra "viewer".

Modules:
    demonstrating: a demonstration by hand
    handles: what is drawn, and how it is moved
    local_server: the address, and its errors
    solving: picks, paths and energies of what is dragged
    stage: a folder on the screen, and what the mouse does
    worker: computes the latest request only
"""
