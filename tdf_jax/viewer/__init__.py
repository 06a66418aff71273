"""`tdf view`: imitations, landscapes, simulated episodes and joint trajectories in a browser.

It needs the extra "viewer".

Modules:
    demonstrating: a demonstration by hand
    energies: an energy landscape on the screen
    episodes: simulated episodes on the screen
    handles: what is drawn, and how it is moved
    joints: a robot on the screen that moves through a joint trajectory
    local_server: the address, and its errors
    player: a slider over time, with a button that plays it
    solving: picks, paths and energies of what is dragged
    sources: what a folder or a file holds
    stage: an imitation on the screen, and what the mouse does
    worker: computes the latest request only
"""
