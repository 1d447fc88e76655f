"""The claims of §5.1 and §5.2: policies compared, and samples needed."""

from __future__ import annotations

from ril.report.paper.prose import (
    GOALS,
    IMITATING,
    REINFORCED,
    Statement,
    aer,
    average_p,
    cells,
    four,
    printed_p,
    steps,
    table1,
    unsolved,
)

STATEMENTS = (
    Statement(
        "§5.1",
        "RIL is the furthest from π*, at 9.6476",
        lambda p: table1(p, "divergence").max(),
        "9.6476",
    ),
    Statement(
        "§5.1",
        "of greedy actions RIL is the most similar, at 0.8094",
        lambda p: table1(p, "greedy_divergence").min(),
        "0.8094",
    ),
    Statement(
        "§5.1",
        "of greedy actions RL is as distant as IL",
        lambda p: table1(p, "greedy_divergence")[["DQN₁", "IUPE"]].diff().iloc[1],
        "0.0000",
    ),
    Statement(
        "§5.1",
        "π* is an optimal policy",
        lambda p: table1(p, "reward")[lambda r: r > r["π*"]],
        why="no policy returns more than an optimal one, unless the episodes differ",
    ),
    Statement(
        "§5.2.1",
        "RIL reaches P ≥ 1 with one trajectory",
        lambda p: cells(
            p.means("table2", "performance")[["RIL"]], p.means("table2", "performance")[["RIL"]] < 1
        ),
    ),
    Statement(
        "§5.2.1",
        "on CartPole only ILPO and RIL reach 195",
        lambda p: p.means("table2").loc["cartpole", ["BC", "GAIL", "IUPE"]][lambda r: r >= 195],
        why="BC reaches it too",
    ),
    Statement(
        "§5.2.1",
        "on CartPole GAIL's and IUPE's P is around 0.30",
        lambda p: printed_p(p, "cartpole", ["GAIL", "IUPE"]),
        "0.3",
    ),
    Statement(
        "§5.2.1",
        "on CartPole GAIL is only 10 from the goal",
        lambda p: 195 - aer(2, "cartpole", "GAIL")(p),
        "10",
    ),
    Statement(
        "§5.2.1",
        "on Acrobot only RIL is as good as the expert",
        lambda p: p.means("table2").loc["acrobot", ["BC", *IMITATING]][
            lambda r: r >= aer(2, "acrobot", "Expert")(p)
        ],
    ),
    Statement(
        "§5.2.1", "ILPO's P on Acrobot is 0.9", lambda p: printed_p(p, "acrobot", ["ILPO"]), "0.9"
    ),
    Statement(
        "§5.2.1",
        "IUPE's P on Acrobot is 0.8",
        lambda p: printed_p(p, "acrobot", ["IUPE"]),
        "0.8",
        "Table 2 prints a different P, and its AER gives a third",
    ),
    Statement(
        "§5.2.1",
        "a random policy's AER on Acrobot is −482.6",
        aer(2, "acrobot", "Random"),
        "-482.6",
    ),
    Statement("§5.2.1", "GAIL's AER on Acrobot is −279.02", aer(2, "acrobot", "GAIL"), "-279.02"),
    Statement(
        "§5.2.1",
        "on Acrobot ILPO and IUPE are closer to the expert than GAIL",
        lambda p: p.means("table2").loc["acrobot", ["ILPO", "IUPE"]][
            lambda r: r <= aer(2, "acrobot", "GAIL")(p)
        ],
    ),
    Statement(
        "§5.2.1",
        "all IL methods reach P ≈ 0.06 on MountainCar",
        lambda p: printed_p(p, "mountaincar", IMITATING),
        "0.06",
        "0.06 is the sum of GAIL, ILPO and IUPE; the claim for LunarLander is their mean",
    ),
    Statement(
        "§5.2.1",
        "all IL methods reach P ≈ −0.04 on LunarLander",
        lambda p: printed_p(p, "lunarlander", IMITATING),
        "-0.04",
    ),
    Statement(
        "§5.2.1",
        "BC's P on CartPole and Acrobot is 0.9",
        lambda p: p.means("table2", "performance").loc[["cartpole", "acrobot"], "BC"].mean(),
        "0.9",
    ),
    Statement(
        "§5.2.1",
        "BC's P is lower on MountainCar and LunarLander",
        lambda p: p.means("table2", "performance")["BC"][
            lambda r: r.index.isin(["mountaincar", "lunarlander"]) & (r >= r["acrobot"])
        ],
    ),
    Statement(
        "§5.2.2",
        "except on Acrobot, DQN₂ needs fewer timesteps than the other RL methods",
        lambda p: cells(
            steps(p).drop(index="acrobot")[REINFORCED],
            steps(p).drop(index="acrobot")[REINFORCED].lt(steps(p)["DQN₂"].drop("acrobot"), axis=0),
        ),
        why="Table 3 has fewer for these",
    ),
    Statement("§5.2.2", "DQN₂'s average P is 0.92", lambda p: average_p(p, ["DQN₂"]), "0.92"),
    Statement(
        "§5.2.2",
        "PPO's and ACKTR's average P is ≈ 0.85",
        lambda p: average_p(p, ["PPO", "ACKTR"]),
        "0.85",
    ),
    Statement(
        "§5.2.2",
        "PPO and DQN₂ hardly differ on CartPole",
        lambda p: four(p, ["PPO", "DQN₂"]).loc["cartpole"].diff().iloc[1],
        "0",
    ),
    Statement(
        "§5.2.2",
        "PPO needs fewer samples on Acrobot than DQN₂",
        lambda p: steps(p).loc["acrobot", ["DQN₂"]][lambda r: r <= steps(p).loc["acrobot", "PPO"]],
    ),
    Statement(
        "§5.2.2",
        "PPO needs 524,500 samples on Acrobot",
        lambda p: steps(p).loc["acrobot", "PPO"],
        "524500",
        "524,500 is the difference of PPO and DQN₂ on MountainCar (Table 3)",
    ),
    Statement(
        "§5.2.2",
        "ACKTR is the best RL method on MountainCar",
        lambda p: four(p, REINFORCED).loc["mountaincar"][lambda r: r > r["ACKTR"]],
    ),
    Statement(
        "§5.2.2",
        "ACKTR needs ≈ 500,000 timesteps on MountainCar",
        lambda p: steps(p).loc["mountaincar", "ACKTR"],
        "5e5",
    ),
    Statement(
        "§5.2.2",
        "ACKTR needs 477,755 timesteps more than RIL on MountainCar",
        lambda p: -steps(p).loc["mountaincar", ["ACKTR", "RIL"]].diff().iloc[1],
        "477755",
    ),
    Statement(
        "§5.2.2",
        "on MountainCar PPO needs fewer timesteps than all others",
        lambda p: steps(p).loc["mountaincar"][lambda r: r < r["PPO"]],
        why="it holds for LunarLander, where Table 3 marks PPO with †",
    ),
    Statement(
        "§5.2.2",
        "PPO does not reach MountainCar's goal",
        lambda p: four(p, "PPO").loc["mountaincar"][lambda r: r >= GOALS["mountaincar"]],
    ),
    Statement(
        "§5.2.2",
        "RIL reaches its maximum in all environments with fewer samples than RL methods",
        lambda p: cells(steps(p), steps(p).lt(steps(p)["RIL"], axis=0)),
        why="Table 3 has fewer for these, and DQN₂ reaches the goal",
    ),
    Statement(
        "§5.2.2", "RIL reaches the goal of all environments", lambda p: unsolved(four(p, "RIL"))
    ),
    Statement(
        "Table 3",
        "RIL's samples lead to its return in Table 4, with 100 trajectories",
        lambda p: steps(p)["RIL"][lambda r: r < p.means("table6", "expert_samples")["100"]],
        why="one iteration with 100 trajectories counts more expert samples (Table 6)",
    ),
)
