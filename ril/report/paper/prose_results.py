"""The claims of §5.3 to §7: returns and ablations."""

from __future__ import annotations

import pandas as pd

from ril.report.paper.prose import (
    HARD,
    IMITATING,
    REINFORCED,
    Statement,
    aer,
    average_p,
    by_expert,
    cells,
    deviation,
    four,
    p_of,
    rising,
    unsolved,
)

STATEMENTS = (
    Statement(
        "§5.3",
        "100 trajectories are ≈ 100× more samples",
        lambda p: (samples := p.means("table6", "expert_samples"))["100"].div(samples["1"]).mean(),
        "1e2",
    ),
    Statement(
        "§5.3",
        "DQN₁ is lower than every other RL method",
        lambda p: cells(
            four(p, REINFORCED[1:]), four(p, REINFORCED[1:]).le(four(p, "DQN₁")["DQN₁"], axis=0)
        ),
    ),
    Statement(
        "§5.3",
        "on CartPole all methods reach 195",
        lambda p: p.means("table4").loc["cartpole"][lambda r: r < 195],
    ),
    Statement(
        "§5.3",
        "except on CartPole, DQN₁ is closer to the random policy than to the expert",
        lambda p: p_of(p, "table4")["DQN₁"][HARD][lambda r: r > 0.5],
        why="P above 0.5 is closer to the expert",
    ),
    Statement(
        "§5.3",
        "DQN₂ reaches all goals but MountainCar's",
        lambda p: unsolved(four(p, "DQN₂")).drop("mountaincar", errors="ignore"),
    ),
    Statement(
        "§5.3",
        "no other RL method reaches LunarLander's goal",
        lambda p: four(p, ["DQN₁", "PPO", "ACKTR"]).loc["lunarlander"][lambda r: r >= 200],
    ),
    Statement(
        "§5.3",
        "PPO is the best RL method on Acrobot",
        lambda p: four(p, REINFORCED).loc["acrobot"][lambda r: r > r["PPO"]],
    ),
    Statement(
        "§5.3",
        "except on Acrobot, PPO is worse than ACKTR and DQN₂",
        lambda p: cells(
            four(p, ["ACKTR", "DQN₂"]).drop("acrobot"),
            four(p, ["ACKTR", "DQN₂"])
            .drop("acrobot")
            .lt(four(p, "PPO")["PPO"].drop("acrobot"), axis=0),
        ),
        why="these are below PPO in Table 4",
    ),
    Statement(
        "§5.3",
        "LunarLander has the lowest P of all environments",
        lambda p: p_of(p, "table4").mean(axis=1)[lambda r: r < r["lunarlander"]],
    ),
    Statement(
        "§5.3",
        "the average P of the RL methods is ≈ 0.8",
        lambda p: average_p(p, REINFORCED),
        "0.8",
    ),
    Statement(
        "§5.3",
        "on LunarLander the RL methods' results are positive",
        lambda p: four(p, REINFORCED).loc["lunarlander"][lambda r: r < 0],
        why="it is negative in Table 4",
    ),
    Statement(
        "§5.3",
        "on LunarLander the IL methods except BC are closer to the random policy",
        lambda p: p_of(p, "table4").loc["lunarlander", IMITATING][lambda r: r > 0.5],
        why="P above 0.5 is closer to the expert",
    ),
    Statement(
        "§5.3",
        "IL methods' average on Acrobot is ≈ (−)81.69",
        lambda p: four(p, IMITATING).loc["acrobot"].mean(),
        "-81.69",
    ),
    Statement(
        "§5.3",
        "RL methods' average on Acrobot, without DQN₁, is ≈ (−)86.87",
        lambda p: four(p, REINFORCED[1:]).loc["acrobot"].mean(),
        "-86.87",
    ),
    Statement("§5.3", "BC's average P is 1.01", lambda p: average_p(p, ["BC"]), "1.01"),
    Statement(
        "§5.3",
        "RIL is equal to or above the expert everywhere",
        lambda p: p_of(p, "table4")["RIL"][lambda r: r < 1],
    ),
    Statement(
        "§5.3",
        "no RL method is above RIL, except DQN₂ on LunarLander",
        lambda p: cells(
            four(p, REINFORCED), four(p, REINFORCED).gt(four(p, "RIL")["RIL"], axis=0)
        ).drop(("lunarlander", "DQN₂"), errors="ignore"),
    ),
    Statement("§5.3", "RIL's AER on LunarLander is 266.55", aer(4, "lunarlander", "RIL"), "266.55"),
    Statement(
        "§5.3",
        "RIL's ± on LunarLander is 19.34",
        lambda p: p.stds("table4").loc["lunarlander", "RIL"],
        "19.34",
    ),
    Statement(
        "§5.3", "DQN₂'s AER on LunarLander is 273.07", aer(4, "lunarlander", "DQN₂"), "273.07"
    ),
    Statement(
        "§5.3",
        "RIL is 6.52 from DQN₂ on LunarLander",
        lambda p: aer(4, "lunarlander", "DQN₂")(p) - aer(4, "lunarlander", "RIL")(p),
        "6.52",
    ),
    Statement(
        "§5.3",
        "RIL's average ± is smaller than every method's but BC's",
        lambda p: p.stds("table4").drop(columns="BC").mean()[lambda r: r < r["RIL"]],
    ),
    Statement("§5.3", "RIL's average ± is ≈ 6.58", lambda p: deviation(p, "RIL"), "6.58"),
    Statement("§5.3", "DQN₂'s average ± is ≈ 23", lambda p: deviation(p, "DQN₂"), "23"),
    Statement("§5.3", "BC's average ± is 2.22", lambda p: deviation(p, "BC"), "2.22"),
    Statement(
        "§5.3",
        "BC's average ± is 4.36 lower than RIL's",
        lambda p: deviation(p, "RIL") - deviation(p, "BC"),
        "4.36",
    ),
    Statement("§6.2", "RIL* has −200.00 on MountainCar", aer(5, "mountaincar", "RIL*"), "-200.00"),
    Statement("§6.2", "RIL* has 382.95 on CartPole", aer(5, "cartpole", "RIL*"), "382.95"),
    Statement("§6.2", "RIL* has −493.63 on Acrobot", aer(5, "acrobot", "RIL*"), "-493.63"),
    Statement(
        "§6.3",
        "on CartPole RIL has 500 with any number of trajectories",
        lambda p: p.means("table6").loc["cartpole"][lambda r: r != 500],
    ),
    Statement(
        "§6.3",
        "on Acrobot 100 trajectories are best, with −75.72",
        lambda p: p.means("table6").loc["acrobot"].max(),
        "-75.72",
    ),
    Statement(
        "§6.3", "that is a P of 1.02", lambda p: p_of(p, "table4").loc["acrobot", "RIL"], "1.02"
    ),
    Statement(
        "§6.3",
        "less than 1 % better than with one",
        lambda p: (p_of(p, "table4") / p_of(p, "table2")).loc[["acrobot"], "RIL"][
            lambda r: r >= 1.01
        ],
    ),
    Statement(
        "§6.3",
        "on MountainCar all are within the ± of Table 2",
        lambda p: p.means("table6").loc["mountaincar"][
            lambda r: (
                (r - aer(2, "mountaincar", "RIL")(p)).abs()
                > p.stds("table2").loc["mountaincar", "RIL"] + 0.015
            )
        ],
        why="it is just outside",
    ),
    Statement(
        "§6.3",
        "on MountainCar all are within the ± of Table 4",
        lambda p: p.means("table6").loc["mountaincar"][
            lambda r: (
                (r - aer(4, "mountaincar", "RIL")(p)).abs()
                > p.stds("table4").loc["mountaincar", "RIL"] + 0.015
            )
        ],
    ),
    Statement(
        "§6.3",
        "on LunarLander RIL deteriorates as the expert's samples increase",
        lambda p: p.means("table6").loc["lunarlander"][lambda r: r > r["1"]],
        why="from 25 trajectories on it improves, and exceeds the result of one in the end",
    ),
    Statement(
        "§6.4.1",
        "on CartPole k makes no difference",
        lambda p: p.means("table7").loc["cartpole"][lambda r: r != 500],
    ),
    Statement(
        "§6.4.1",
        "on Acrobot RIL degrades as k increases from 2",
        lambda p: rising(p.means("table7").loc[:, "2":], ["acrobot"]),
    ),
    Statement(
        "§6.4.1",
        "k = 2 is the best",
        lambda p: cells(p.means("table7"), p.means("table7").gt(p.means("table7")["2"], axis=0)),
    ),
    Statement(
        "§6.4.1",
        "on MountainCar k = 1 and 4 yield ≈ −150",
        lambda p: p.means("table7").loc["mountaincar", ["1", "4"]].mean(),
        "-1.5e2",
    ),
    Statement(
        "§6.4.1",
        "on MountainCar the other k have a standard deviation of 5.08",
        lambda p: p.means("table7").loc["mountaincar", "1.5":"3.5"].std(),
        "5.08",
    ),
    Statement(
        "§6.4.1",
        "that is lower than all RL methods' in Table 4",
        lambda p: p.stds("table4").loc["mountaincar", REINFORCED][lambda r: r <= 5.08],
    ),
    Statement(
        "§6.4.1",
        "on LunarLander RIL deteriorates as k deviates from 2",
        lambda p: pd.concat(
            rising(p.means("table7").loc[:, side], ["lunarlander"])
            for side in (["2", "1.5", "1"], ["2", "2.5", "3", "3.5", "4"])
        ),
    ),
    Statement(
        "§6.4.1",
        "on MountainCar k = 1 is the worst and 4 the second worst",
        lambda p: p.means("table7").loc["mountaincar", "1.5":"3.5"][
            lambda r: r <= aer(7, "mountaincar", "4")(p)
        ],
    ),
    Statement(
        "§6.4.2",
        "n = 112 is one of four values",
        lambda p: float(p.means("table8").columns[1]),
        "112",
        "Table 8 has another n in its place",
    ),
    Statement(
        "§6.4.2",
        "on CartPole n makes no difference",
        lambda p: p.means("table8").loc["cartpole"][lambda r: r != 500],
    ),
    Statement(
        "§6.4.2", "RIL deteriorates as n decreases", lambda p: rising(p.means("table8"), HARD)
    ),
    Statement(
        "§6.4.2",
        "with any n RIL still solves each environment",
        lambda p: unsolved(p.means("table8")),
        why="these are below what §4.1 calls solved",
    ),
    Statement(
        "§7",
        "on CartPole RIL has 500 with any expert",
        lambda p: p.means("table9").loc["cartpole"].dropna()[lambda r: r != 500],
    ),
    Statement(
        "§7",
        "RIL degrades gradually with the expert",
        lambda p: rising(by_expert(p), ["acrobot", "mountaincar"]),
        why="these rise although the expert's return falls",
    ),
    Statement(
        "§7",
        "RIL decreases only 10.91 points on Acrobot as the expert decays",
        lambda p: -by_expert(p).loc["acrobot"].dropna().iloc[[0, -1]].diff().iloc[1],
        "10.91",
        "10.91 is the decrease on MountainCar, whose expert decays by 44 points (Acrobot: 165)",
    ),
)
